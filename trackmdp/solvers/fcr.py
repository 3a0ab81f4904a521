"""First cost reduction (Fuemmeler and Veeravalli 2008, 2011): act as if nothing were observed any more.

The opposite simplification of Q_MDP, which acts as if the position were known after every action.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.cover import Offer, best_sets
from trackmdp.solvers.layers import within_window
from trackmdp.solvers.prediction import predict
from trackmdp.world.model import World


def solve(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Sense j at n misses iff p_d(j) (e_x P^(n+1))_j r >= c_j: the prediction takes no notice of the misses.

    Args:
        world: the problem.
        in_grid: charge sensors only while the target is in the grid: p_d p_j r >= c_j p_in.
    """
    moved, sensed = sparse.eye_array(world.num_cells, format="csr"), []
    for n in range(world.num_choices):
        seen = predict(world, moved, n)
        charged = seen.inside if in_grid else np.ones(world.num_cells)
        # seen.mass is e_x P^(n+1) itself: since nothing is taken away at a miss, no probability of misses has to be
        # divided by.
        offer = Offer(seen.mass * world.detects(seen.cells) * world.reward, world.cost, charged, ties=True)
        on = best_sets(world, seen.rows, seen.cells, offer, within_window(world, seen.rows, seen.cells))
        sensed.append((on.rows, on.sensors))
        moved = seen.part(np.ones(len(seen.mass)))  # nothing is taken away: a miss is not learned from
    return PolicyTable.from_sensed(world, sensed)
