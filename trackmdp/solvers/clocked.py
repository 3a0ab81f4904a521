"""The clocked policy: the sets read off the clocked bound."""

from __future__ import annotations

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.cover import Offer
from trackmdp.solvers.prediction import Prediction, unroll
from trackmdp.world.model import World


def solve(world: World) -> PolicyTable:
    """The policy that senses j iff p_d m_j (r + U(j, 0) - U(j, n + 1)) > c_j sum(m), m the predicted undetected mass.

    Where sensors have footprints, the set whose cells gain most of that.

    Optimal, with sensors that never miss, wherever at most one cell of positive probability is left unsensed: then a
    miss tells where the target is, as the bound assumes.
    """
    table = clocked_table(world).table

    def gains(seen: Prediction) -> Offer:
        credit = world.reward + table[seen.cells, 0] - table[seen.cells, seen.n + 1]
        return Offer(seen.mass * world.detects(seen.cells) * credit, world.cost, seen.inside)

    return unroll(world, gains)
