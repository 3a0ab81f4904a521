"""Q_MDP (Littman, Cassandra and Kaelbling 1995): act as if the position were known after every action."""

from __future__ import annotations

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.cover import Offer
from trackmdp.solvers.prediction import Prediction, unroll
from trackmdp.world.model import World


def solve(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Q_MDP, eq. qmdp_policy: sense j iff p_d(j) p_j >= c_j / r.

    p_j is the predicted probability of cell j given the misses so far, the exit being one of the possibilities; p_d(j)
    is 1 for a sensor that never misses.

    Args:
        world: the problem.
        in_grid: charge sensors like the reward does, only while the target is in the grid: p_d p_j r >= c_j p_in.
    """

    def worth_it(seen: Prediction) -> Offer:
        # multiplied by the probability of the misses, which need not be divided by then
        charged = seen.inside if in_grid else seen.before
        return Offer(seen.mass * world.detects(seen.cells) * world.reward, world.cost, charged, ties=True)

    return unroll(world, worth_it)
