"""First cost reduction (Fuemmeler and Veeravalli 2008, 2011): act as if nothing were observed any more.

The opposite simplification of Q_MDP, which acts as if the position were known after every action.
"""

from __future__ import annotations

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.cover import Offer
from trackmdp.solvers.prediction import Prediction, unroll
from trackmdp.world.model import World


def solve(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Sense j at n misses iff p_d(j) (e_x P^(n+1))_j r >= c_j: the prediction takes no notice of the misses.

    Args:
        world: the problem.
        in_grid: charge sensors only while the target is in the grid: p_d p_j r >= c_j p_in.
    """

    def worth_it(seen: Prediction) -> Offer:
        # seen.mass is e_x P^(n+1) itself: since nothing is taken away at a miss, no probability of misses has to be
        # divided by.
        charged = seen.inside if in_grid else np.ones(world.num_cells)
        return Offer(seen.mass * world.detects(seen.cells) * world.reward, world.cost, charged, ties=True)

    return unroll(world, worth_it, learns=False)
