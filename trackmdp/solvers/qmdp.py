"""Rules of thumb, thresholds on where the target is predicted to be: Q_MDP, first cost reduction, myopic, clocked.

Q_MDP (Littman, Cassandra and Kaelbling 1995) acts as if the position were known after every action, and first cost
reduction (Fuemmeler and Veeravalli 2008, 2011) as if nothing were observed any more.
"""

from __future__ import annotations

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.cover import Offer
from trackmdp.solvers.prediction import Prediction, unroll
from trackmdp.world.model import Array, World


def solve(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Q_MDP, eq. qmdp_policy: sense j iff p_d(j) p_j >= c_j / r.

    p_j is the predicted probability of cell j given the misses so far, the exit being one of the possibilities; p_d(j)
    is 1 for a sensor that never misses.

    Args:
        world: the problem.
        in_grid: charge sensors like the reward does, only while the target is in the grid: p_d p_j r >= c_j p_in.
    """
    # multiplied by the probability of the misses, which need not be divided by then
    return unroll(world, lambda seen: _offer(world, seen, seen.inside if in_grid else seen.before))


def fcr(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Sense j at n misses iff p_d(j) (e_x P^(n+1))_j r >= c_j: the prediction takes no notice of the misses.

    Args:
        world: the problem.
        in_grid: charge sensors only while the target is in the grid: p_d p_j r >= c_j p_in.
    """
    # seen.mass is e_x P^(n+1) itself: since nothing is taken away at a miss, no probability of misses has to be divided
    # by.
    always = np.ones(world.num_cells)
    return unroll(world, lambda seen: _offer(world, seen, seen.inside if in_grid else always), learns=False)


def myopic(world: World, *, threshold: float | None = None) -> PolicyTable:
    """Sense j iff the probability that it reports the target, given the misses so far, is at least `threshold`.

    Without one, sense where the sensor earns its price in this very step: p_d(j) p_j r >= c_j p_in.
    """
    if threshold is None:
        return solve(world, in_grid=True)
    # The threshold is as a price, the same of all sensors.
    limit = np.full(world.total_sensors, threshold)
    return unroll(world, lambda seen: Offer(seen.mass * world.detects(seen.cells), limit, seen.before, ties=True))


def clocked_policy(world: World) -> PolicyTable:
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


def _offer(world: World, seen: Prediction, charged: Array) -> Offer:
    """What sensing earns at once, and its price where it is `charged`."""
    return Offer(seen.mass * world.detects(seen.cells) * world.reward, world.cost, charged, ties=True)
