"""First cost reduction (Fuemmeler and Veeravalli 2008, 2011): act as if nothing were observed any more.

The opposite simplification of Q_MDP, which acts as if the position were known after every action.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.solvers.qmdp import TIE
from trackmdp.solvers.renewal import row_index, row_sums
from trackmdp.world.model import BoolArray, World

__all__ = ["solve"]


def solve(world: World, *, in_grid: bool = False) -> BoolArray:
    """Chains that sense j at n misses iff (e_x P^(n+1))_j r >= c_j: the prediction takes no notice of the misses.

    Args:
        world: the problem.
        in_grid: charge sensors only while the target is in the grid: p_j r >= c_j p_in.
    """
    chains = np.zeros((world.num_cells, world.num_choices, world.num_cells), dtype=bool)
    predicted = sparse.eye_array(world.num_cells, format="csr")
    for n in range(world.num_choices):
        predicted = predicted @ world.kernel
        rows = row_index(predicted)
        charged = row_sums(predicted)[rows] if in_grid else 1.0
        worth_it = predicted.data * world.reward >= world.cost[predicted.indices] * charged * (1.0 - TIE)
        chains[rows, n, predicted.indices] = worth_it
    return chains
