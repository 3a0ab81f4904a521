"""The clocked policy: the sets read off the clocked bound."""

from __future__ import annotations

from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.chains import Prediction, unroll
from trackmdp.world.model import Array, BoolArray, World

__all__ = ["solve"]


def solve(world: World, *, table: Array | None = None) -> BoolArray:
    """Chains that sense j iff m_j (r + U(j, 0) - U(j, n + 1)) > c_j sum(m), m the predicted undetected mass.

    Optimal wherever at most one cell of positive probability is left unsensed.

    Args:
        world: the problem.
        table: `[M, t_max + 2]`, U(x, n); computed when not given.
    """
    bound = clocked_table(world).table if table is None else table

    def gains(seen: Prediction) -> BoolArray:
        credit = world.reward + bound[seen.cells, 0] - bound[seen.cells, seen.n + 1]
        return seen.mass * credit > world.cost[seen.cells] * seen.inside[seen.rows]

    return unroll(world, gains)
