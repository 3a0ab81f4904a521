"""Solving for policies that remember a key, against targets with a hidden mode: a bound, a homotopy and exchange.

A proof for plans of keys that tell all there is to know: no plan of any key is worth more.

Where a detection tells the mode, the keys are the states in which the target is located, and V* the least V that no
plan improves on. Given V, the sets of the last free choice part by sensor, so that a key's best plan is found by going
through the sets before it: the sensors in reach after one move alone for t_max = 1, none for t_max = 0.

Let ρ be the most that any plan is worth more than V, and L(z) the expected steps of an episode from z, which no policy
changes. A renewal takes a step or more, so that L after it is L(z) - 1 at most: V + ρ L is improved on by no plan, and
is a bound on V*.
"""

from __future__ import annotations

import time

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.keyed import KeyedPairs, evaluate_keys
from trackmdp.solvers.keyed_exchange import exchanged_pairs
from trackmdp.solvers.renewal import IndexArray, accumulate, check_length, per_row, row_index
from trackmdp.solvers.solution import Solution
from trackmdp.world.model import Array
from trackmdp.world.modes import HiddenWorld

_MOST_SENSORS = 14
"""Of a key, in all sets but the last, up to which all 2^14 choices are gone through."""


def told_bound(pairs: KeyedPairs, value: Array) -> Array | None:
    """`[keys]` V + ρ L, or None where there are too many plans.

    Args:
        pairs: of keys that tell the mode.
        value: `[keys]` V of a policy; the bound is tight where it is optimal.
    """
    numbers, sensors = _numbered(pairs)
    if sensors > _MOST_SENSORS:
        return None
    best = np.full(pairs.count, -np.inf)
    for choice in range(2**sensors):
        best = np.maximum(best, _worth(pairs, value, [(choice >> number) & 1 for number in numbers]))
    more = max(0.0, float((best - value).max()))
    return value + more * accumulate(pairs.world.kernel, np.ones(pairs.count))


def _numbered(pairs: KeyedPairs) -> tuple[list[IndexArray], int]:
    """For each set but the last `[G]` the number of each sensor among all of its key's, and how many those are."""
    numbers, before = [], np.zeros(pairs.count, dtype=np.int64)
    for groups in pairs.groups[:-1]:
        owner = groups // pairs.world.num_cells
        # Owners are in order: those of 0 0 2 begin at 0 and 2, and their sensors have the numbers 0 1 0.
        numbers.append(before[owner] + np.arange(len(owner)) - np.searchsorted(owner, owner))
        before += np.bincount(owner, minlength=pairs.count)
    return numbers, int(before.max())


def _worth(pairs: KeyedPairs, value: Array, sets: list[IndexArray]) -> Array:
    """`[keys]` worth of the `sets` `[G]`, 0 or 1, and of the best last one after them."""
    world, last, worth = pairs.world, pairs.world.t_max, np.zeros(pairs.count)
    found = [world.reward + value[following] for following in pairs.following]
    missed = pairs.layers[-1].moves @ found[-1] - world.safe_cost * pairs.stay[-2]
    mass = np.ones(pairs.count)
    for n, groups in enumerate(pairs.groups):
        mass, rows = mass @ pairs.layers[n].moves, pairs.layers[n].rows
        key, cell = np.divmod(groups, world.num_cells)
        price = world.cost[cell] * per_row(rows, mass, pairs.count)[key]
        hits = mass * pairs.chance[n]
        if n == last:
            gain = per_row(pairs.group[n], hits * (found[n] - missed), len(groups)) - price
            return worth + per_row(key, np.maximum(gain, 0.0), pairs.count) + per_row(rows, mass * missed, pairs.count)
        hits = hits * sets[n][pairs.group[n]]
        worth = worth + per_row(rows, hits * found[n], pairs.count) - per_row(key, price * sets[n], pairs.count)
        mass = mass - hits
    raise AssertionError("no free choice")


_SETTLED = 1e-10  # of the bound: it is approached from above, so that stopping anywhere is valid
_ROUNDING = 1e-15  # of an entry, in one round


def mode_bound(world: HiddenWorld) -> Array:
    """`[M · H, t_max + 2]` U(z, n), the clocked bound: cell and mode are revealed after every action.

    U(z, n) = sum over cells j of max{ sum over z' in j of P_zz' (p_d (r + U(z', 0)) + (1 - p_d) U(z', n+1)) - c_j P_in,
    sum of P_zz' U(z', n+1) }. It is the fixed point of a monotone map, approached from r · (steps of an episode), which
    is above it: every iterate is a bound.

    Such iterates alone fall by a share 1 - p_exit of what is left, for as many rounds as an episode has steps. So each
    goes on to where it would fall to: with T the map, L the steps of an episode, the same whatever is chosen, so that
    P L = L - 1, and T U <= U - a, T(U - a L) = T U - a (L - 1) <= U - a L, which is a bound as well.
    """
    kernel, stay = world.kernel, world.stay_probability
    rows, cell = row_index(kernel), kernel.indices // world.modes
    groups, group = np.unique(rows.astype(np.int64) * world.num_cells + cell, return_inverse=True)
    owner, sensor = np.divmod(groups, world.num_cells)
    price, chance = world.cost[sensor] * stay[owner], world.detection[cell]
    steps = accumulate(kernel, np.ones(world.num_states))
    check_length(steps)
    bound = np.tile(world.reward * steps[:, None], (1, world.num_choices + 1))
    while True:
        before = bound.copy()
        found = world.reward + before[kernel.indices, 0]
        bound[:, -1] = per_row(rows, kernel.data * found, world.num_states) - world.safe_cost * stay
        for n in range(world.num_choices - 1, -1, -1):
            missed = before[kernel.indices, n + 1]
            on = per_row(group, kernel.data * (chance * found + (1.0 - chance) * missed), len(groups)) - price
            off = per_row(group, kernel.data * missed, len(groups))
            bound[:, n] = per_row(owner, np.maximum(on, off), world.num_states)
        # Less than it falls by, for what rounding adds to that would count L times.
        fall = (before - bound).min() - _ROUNDING * np.abs(before).max()
        bound -= max(fall, 0.0) * (steps[:, None] - 1.0)
        if (before - bound).max() <= _SETTLED * max(1.0, float(np.abs(bound).max())):
            return bound


def cell_bound(world: HiddenWorld) -> Array:
    """`[M]` `mode_bound` just after a detection in each cell, any mode as likely."""
    return _of_cells(world, mode_bound(world))


def _of_cells(world: HiddenWorld, bound: Array) -> Array:
    """`[M]` of a bound `[M · H, t_max + 2]`, at n = 0."""
    return bound[:, 0].reshape(world.num_cells, world.modes).mean(axis=1)


def solve_keys(world: HiddenWorld, *, start: PolicyTable | None = None, steps: int = 12, rounds: int = 20) -> Solution:
    """A policy over keys by the homotopy from the bound's credit to the exact one, then by exchange.

    Args:
        world: whose `memory` says what a key is.
        start: a policy of the same keys that the one found is no worse than; None: no sensor on.
        steps: of the homotopy.
        rounds: of exchange at most; one is kept only if the exact AIHTR rises.
    """
    began, pairs, bound = time.monotonic(), KeyedPairs(world), mode_bound(world)
    best = pairs.sets(PolicyTable.none(world) if start is None else start)
    value, visits, aihtr = pairs.value(best)
    now = (best, value, visits, aihtr)
    for step in range(-1, steps + 1):
        sets = pairs.improved(*now[:3], bound, 1.0 - max(step, 0) / steps)
        now = (sets, *pairs.value(sets))
        if now[3] > aihtr:
            best, value, visits, aihtr = now
    for _ in range(rounds):
        tried = exchanged_pairs(pairs, best, value, visits)
        found = pairs.value(tried)
        if found[2] <= aihtr + 1e-12 * abs(aihtr):
            break
        best, (value, visits, aihtr) = tried, found
    table = pairs.table(best)
    upper = _of_cells(world, bound)
    evaluation = evaluate_keys(world, table)
    if world.revealed > 1 and (proved := told_bound(pairs, value)) is not None:
        proved = proved.reshape(world.num_cells, -1).mean(axis=1)
        upper = np.maximum(np.minimum(upper, proved), evaluation.value)  # not below what is attained, by rounding
    certified = float(upper.mean()) - evaluation.aihtr <= 1e-6 * max(1.0, abs(evaluation.aihtr))
    return Solution(table, evaluation, upper, certified, time.monotonic() - began, nodes=0, interrupted=False)
