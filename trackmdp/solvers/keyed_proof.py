"""A proof for plans of keys that tell all there is to know: no plan of any key is worth more.

Where a detection tells the mode, the keys are the states in which the target is located, and V* the least V that no
plan improves on. Given V, the sets of the last free choice part by sensor, so that a key's best plan is found by going
through the sets before it: the sensors in reach after one move alone for t_max = 1, none for t_max = 0.

Let ρ be the most that any plan is worth more than V, and L(z) the expected steps of an episode from z, which no policy
changes. A renewal takes a step or more, so that L after it is L(z) - 1 at most: V + ρ L is improved on by no plan, and
is a bound on V*.
"""

from __future__ import annotations

import numpy as np

from trackmdp.solvers.keyed import KeyedPairs
from trackmdp.solvers.renewal import IndexArray, accumulate, per_row
from trackmdp.world.model import Array

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
    bound: Array = value + more * accumulate(pairs.world.kernel, np.ones(pairs.count))
    return bound


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
