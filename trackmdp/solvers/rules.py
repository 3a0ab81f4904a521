"""Rules of thumb, thresholds on where the target is predicted to be: Q_MDP, first cost reduction, myopic, clocked.

Q_MDP (Littman, Cassandra and Kaelbling 1995) acts as if the position were known after every action, and first cost
reduction (Fuemmeler and Veeravalli 2008, 2011) as if nothing were observed any more. All of them remember the located
cell alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.entries import per_row
from trackmdp.arrays.types import Array
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.choose import TIE
from trackmdp.sensing.decisions import sensing
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.walk import Step, Walk, all_events
from trackmdp.world.model import World

Offer: TypeAlias = tuple[Array, Array, Array]
"""Of sensing in one step, for all located cells: `[E]` gain of a report, `[S]` price of each sensor, and `[M]` factor
of the prices for each located cell."""
Rule: TypeAlias = Callable[[Step, Array, Array], Offer]
"""From a step of all located cells, the probability `[M]` of the misses so far, and jointly with them the probability
`[E]` of the target's moving to each entry."""


def qmdp(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Q_MDP, eq. qmdp_policy: sense j iff p_d(j) p_j >= c_j / r.

    p_j is the predicted probability of cell j given the misses so far, the exit being one of the possibilities; p_d(j)
    is 1 for a sensor that never misses.

    Args:
        world: the problem.
        in_grid: charge sensors like the reward does, only while the target is in the grid: p_d p_j r >= c_j p_in.
    """
    # Multiplied by the probability of the misses, which need not be divided by then.

    def rule(step: Step, before: Array, mass: Array) -> Offer:
        return _offer(world, mass, step.summed(mass) if in_grid else before)

    return unroll(world, rule)


def fcr(world: World, *, in_grid: bool = False) -> PolicyTable:
    """Sense j at n misses iff p_d(j) (e_x P^(n+1))_j r >= c_j: the prediction takes no notice of the misses.

    Args:
        world: the problem.
        in_grid: charge sensors only while the target is in the grid: p_d p_j r >= c_j p_in.
    """
    # Without learning `mass` is e_x P^(n+1) itself: no probability of misses has to be divided by.
    always = np.ones(world.num_cells)

    def rule(step: Step, _: Array, mass: Array) -> Offer:
        return _offer(world, mass, step.summed(mass) if in_grid else always)

    return unroll(world, rule, learns=False)


def myopic(world: World, *, threshold: float | None = None) -> PolicyTable:
    """Sense j iff the probability that it reports the target, given the misses so far, is at least `threshold`.

    Without one, sense where the sensor earns its price in this very step: p_d(j) p_j r >= c_j p_in.
    """
    if threshold is None:
        return qmdp(world, in_grid=True)
    # The threshold is as a price, the same of all sensors.
    limit = np.where(world.available, threshold, world.prices) * (1.0 - TIE)
    return unroll(world, lambda _, before, mass: (mass, limit, before))


def clocked_policy(world: World) -> PolicyTable:
    """The policy that senses j iff p_d m_j (r + U(j, 0) - U(j, n + 1)) > c_j sum(m), m the predicted undetected mass.

    Where sensors share cells, the set that gains most of that.

    Optimal, with sensors that never miss, wherever at most one cell of positive probability is left unsensed: then a
    miss reveals where the target is, as the bound assumes.
    """
    return unroll(world, clocked_rule(world))


def clocked_rule(world: World) -> Rule:
    """The rule of `clocked_policy`."""
    table = clocked_table(world).table

    def gains(step: Step, _: Array, mass: Array) -> Offer:
        credit = world.reward + table[step.states, 0] - table[step.states, step.n + 1]
        return mass * credit, world.prices, step.summed(mass)

    return gains


def unroll(world: World, rule: Rule, *, learns: bool = True) -> PolicyTable:
    """The policy that takes the set of most worth by a `rule` from a prediction, within the task's window.

    Cells of probability zero are never sensed, and after a miss that cannot happen nothing is.
    """
    mass, sensed, located = np.ones(world.num_cells), [], np.arange(world.num_cells)
    keys = world.remembering().keys
    walk = Walk(world, world.motion, all_events(world, keys, world.motion))
    for _ in range(world.num_choices):
        step = walk.move()
        # Joint with the misses, not conditioned on them.
        before, mass = per_row(step.before, mass, world.num_cells), mass @ step.moves
        gain, prices, charge = rule(step, before, mass)
        choice = sensing(world, step.rows, step.states, world.num_cells, located, distinct=True)
        price = prices[choice.sensors] * charge[choice.rows]
        on = choice.best(gain[:, None], price[:, None])
        sensed.append((choice.rows[on[:, 0]], choice.sensors[on[:, 0]]))
        if learns:
            left = 1.0 - choice.report(on)[:, 0]
            mass = mass * left
            walk.keep(left > 0)
    return PolicyTable.from_sensed(world.remembering(), sensed)


def _offer(world: World, mass: Array, charged: Array) -> Offer:
    """The reward of a report at once, and the price of a sensor where it is `charged`; to gain it is enough."""
    return mass * world.reward, world.prices * (1.0 - TIE), charged
