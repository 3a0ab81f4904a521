"""The best plans by listing all sets but the last, which is then a choice of its own (theory.md#proof-of-optimality).

Given the sets before it, the last set of a plan is a best answer (`choose`). So a row's best plan is found by going
through the sets before: the subsets of the sensors in reach, one bit for each, or with a budget the small ones. Where
sensors that never miss share cells, without a budget, only the cells covered by the first set matter: of all sets that
cover the same ones the cheapest counts, and there are 2^Z such subsets of the Z successors.

Most choices need not be followed: with the state revealed after the listed sets they would be worth less than the plan
at hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.entries import ranks
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.sensing.cover import Shared
from trackmdp.solvers.plans import Plans

_MOST_BITS = 14
"""Two to the power of this: choices of all sets but the last up to which they are listed."""
_MOST_PATTERNS = 2**22
"""Choices of all rows; as sets of cells covered, 32 MB of prices."""


def best_plans(
    plans: Plans, sets: list[BoolArray], slack: float, revealed: Array, go_on: Callable[[int], bool]
) -> tuple[Array, list[BoolArray]] | None:
    """All plans of all rows.

    Args:
        plans: with mass 1 in each row.
        sets: `[G, 1]` for each step, the plans at hand.
        slack: plans better by less are not looked for.
        revealed: `[E]`, after the last but one step: worth of one more set with the state known.
        go_on: takes the number of plans looked at since it was asked last; whether to go on.

    Returns:
        `[K]` proved: no plan is worth more; and `[G, 1]` for each step, the plans at hand or better ones. None where
        there are too many choices, or `go_on` ended the listing.
    """
    first = _choices(plans)
    if first is None:
        return None
    worth = plans.worth_of(sets)
    most, best = worth + slack, np.full(len(worth), -1)
    for number in range(first.count):
        tried = first.of(number)
        earned, mass = _earned(plans, tried)
        hopeful = earned + plans.turns[-1].starts @ (mass * revealed) > most
        if not hopeful.any():
            continue
        if not go_on(int(hopeful.sum())):
            return None
        reached = earned + _last(plans, mass, hopeful)
        better = hopeful & (reached > most)
        most, best = np.where(better, reached, most), np.where(better, number, best)
    return most, _plans_of(plans, sets, first, best)


_Tried: TypeAlias = tuple[list[Array], list[Array]]
"""A choice of all listed sets: reports `[E]` of each step, and prices `[K]` relative to the mass in the grid."""


@dataclass(frozen=True)
class _Choices:
    """All choices of the listed sets.

    Attributes:
        count: of them.
        of: the choice of a number.
        sets: from the number of each row `[K]`, -1 for none, to the sets `[G, 1]` of each listed step.
    """

    count: int
    of: Callable[[int], _Tried]
    sets: Callable[[IndexArray], list[BoolArray]]


def _choices(plans: Plans) -> _Choices | None:
    turns = plans.turns[:-1]
    choices = [turn.choice for turn in turns]
    if not turns:
        return _Choices(1, lambda _: ([], []), lambda _: [])
    first = choices[0]
    # The cheapest set that sees a pattern may have more sensors than a budget allows.
    if not (isinstance(first, Shared) and first.perfect and first.budget is None):
        return _of_sensors(plans)
    return _of_patterns(plans, first) if len(turns) == 1 else None


def _of_sensors(plans: Plans) -> _Choices | None:
    """All combinations of sets, in each as many sensors as the budget allows; the first step's change fastest."""
    choices = [turn.choice for turn in plans.turns[:-1]]
    places = [ranks(choice.rows) for choice in choices]
    widths = [int(place.max(initial=-1)) + 1 for place in places]
    most = max(widths) if choices[0].budget is None else min(choices[0].budget, max(widths))
    counts = [sum(math.comb(width, k) for k in range(most + 1)) for width in widths]
    count = math.prod(counts)
    if count > min(2**_MOST_BITS, _MOST_PATTERNS // plans.count) or max(widths) > 62:
        return None
    each_set = [
        [
            sum(1 << j for j in some)
            for k in range(most + 1)
            for some in combinations(range(width), k)
        ]
        for width in widths
    ]
    tables, turns = [np.array(each) for each in each_set], np.cumprod([1, *counts])

    def sets(numbers: IndexArray) -> list[BoolArray]:
        found = []
        for t, choice in enumerate(choices):
            bits = tables[t][numbers[choice.rows] // turns[t] % counts[t]]
            on = (bits >> places[t] & 1 > 0)[:, None]
            found.append(on if choice.allowed is None else on & choice.allowed)
        return found

    def of(number: int) -> _Tried:
        each = sets(np.full(plans.count, number))
        report = [choice.report(on)[:, 0] for choice, on in zip(choices, each, strict=True)]
        price = [(turn.pay @ on)[:, 0] for turn, on in zip(plans.turns, each, strict=False)]
        return report, price

    return _Choices(count, of, sets)


def _of_patterns(plans: Plans, choice: Shared) -> _Choices | None:
    """A bit for each entry of a row at the only listed step, seen by the cheapest set that sees no others."""
    turn = plans.turns[0]
    number = ranks(turn.rows)
    bits = int(number.max(initial=0)) + 1
    if plans.count << bits > _MOST_PATTERNS:
        return None
    kept = choice.distinct(turn.price)
    cheapest = _cheapest(choice.some(kept), turn.price[kept], number, 2**bits)

    def of(pattern: int) -> _Tried:
        return [((pattern >> number) & 1).astype(np.float64)], [cheapest[:, pattern]]

    def sets(numbers: IndexArray) -> list[BoolArray]:
        # The cheapest set that sees a pattern: seeing an entry of it is worth more than all prices, any other a loss as
        # large.
        of_entry = numbers[turn.rows]
        wanted = (of_entry >> number) & 1 > 0
        large = (1.0 + turn.price.sum()) * (of_entry >= 0)
        found = choice.cover(np.where(wanted, large, -large), turn.price, exact=True)
        return [found.on[:, None] > 0]

    return _Choices(2**bits, of, sets)


def _cheapest(choice: Shared, price: Array, number: IndexArray, patterns: int) -> Array:
    """`[K, 2^Z]`, the least price of a set that sees the entries of each pattern and no others; inf without one.

    Bit b of a pattern: the entry of a row with the `number` b is seen.
    """
    pattern = (choice.sees @ (1 << number)).astype(np.int64)
    place = ranks(choice.rows)
    every, cheapest = np.arange(patterns), np.full((choice.count, patterns), np.inf)
    cheapest[:, 0] = 0.0
    for k in range(int(place.max(initial=-1)) + 1):
        pair = np.flatnonzero(place == k)
        row = choice.rows[pair][:, None]
        # With sensor k, patterns become their union with its own; each of the patterns before has one place to go.
        reached = cheapest[row[:, 0]] + price[pair][:, None]
        np.minimum.at(cheapest, (row, every | pattern[pair][:, None]), reached)
    return cheapest


def _earned(plans: Plans, tried: _Tried) -> tuple[Array, Array]:
    """`[K]` reward of the listed sets, and `[E]` the mass that they leave undetected."""
    earned, mass = np.zeros(plans.count), plans.mass[:, 0]
    steps = zip(plans.turns, plans.detected, *tried, strict=False)
    for turn, detected, report, price in steps:
        now = turn.back @ mass
        inside = turn.sums @ now
        paid = np.where(inside > 0, price, 0.0) * inside  # an impossible set costs inf
        earned += turn.sums @ (now * report * detected[:, 0]) - paid
        mass = now * (1.0 - report)
    return earned, mass


def _last(plans: Plans, mass: Array, hopeful: BoolArray) -> Array:
    """`[K]` the most that the best last set earns from `mass` `[E]`, of the rows that are `hopeful`."""
    turn, t = plans.turns[-1], plans.length
    now = turn.back @ (mass * hopeful[turn.before])
    missed = plans.missed[:, 0]
    gain = now * (plans.detected[t - 1][:, 0] - missed)
    price = plans.priced(t, now[:, None])[:, 0]
    most: Array = turn.sums @ (now * missed)
    return most + turn.choice.cover(gain, price, exact=True).upper


def _plans_of(
    plans: Plans, sets: list[BoolArray], first: _Choices, best: IndexArray
) -> list[BoolArray]:
    """The plans of the best choices, in the rows that have one."""
    found = best[:, None] >= 0
    new = [
        np.where(found[turn.choice.rows], on, old)
        for turn, on, old in zip(plans.turns, first.sets(best), sets, strict=False)
    ]
    turn, t = plans.turns[-1], plans.length
    now = plans.pushed(new, t)
    gain = now * (plans.detected[t - 1] - plans.missed)
    last = turn.choice.best(gain, plans.priced(t, now), sets[-1], exact=True)
    return [*new, np.where(found[turn.choice.rows], last, sets[-1])]
