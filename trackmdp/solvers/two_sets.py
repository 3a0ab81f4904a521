"""The best plans of two sets where sensors have footprints, the value V of being located given: all that there are.

What a first set does is told by the cells that it sees. From a located cell the target may move to Z cells, so that
there are 2^Z of these, of which the cheapest set counts that sees them and no others, if there is one. The last set is
a coverage problem (`cover`) of the mass that the first leaves. Most need not be looked at: with the position revealed
after the first set they would be worth less than the plan at hand.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from trackmdp.solvers.bounds import one_set
from trackmdp.solvers.cover import Covering
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.solvers.search import InnerProblem
from trackmdp.world.model import Array, BoolArray

_MOST_PATTERNS = 2**22
"""Of sets of cells seen, of all located cells: 32 MB of prices."""


def best_plans(
    problem: InnerProblem, sets: list[BoolArray], slack: float, looked_at: Callable[[int], bool]
) -> tuple[Array, list[BoolArray]] | None:
    """`[M]` proved: no plan is worth more; and `sets`, with better plans where there are some.

    Args:
        problem: of one renewal with t_max = 1.
        sets: the plans at hand.
        slack: plans better by less are not looked for.
        looked_at: told how many plans more were looked at; whether to go on.

    Returns:
        None where there are too many.
    """
    world, (first, last) = problem.world, problem.layers[1:]
    assert first.covering is not None
    assert last.covering is not None
    m, mass = world.num_cells, np.ones(world.num_cells) @ first.moves
    # Entries are in order of their rows: those of 0 0 2 have the numbers 0 1 0.
    number = np.arange(len(first.rows)) - np.searchsorted(first.rows, first.rows)
    if m << (int(number.max()) + 1) > _MOST_PATTERNS:
        return None
    price = first.covering.price(world.cost, per_row(first.rows, mass, m))
    kept = first.covering.distinct(price)
    cheapest = _cheapest(first.covering.part(kept), price[kept], number)
    revealed, missed = one_set(world, problem.detected, problem.missed), problem.missed[last.cells]
    before = problem.worth(sets, np.ones(m))
    most, seen_best, last_best = before + slack, np.zeros(len(first.rows), dtype=bool), sets[1].copy()
    for pattern in range(cheapest.shape[1]):
        seen = (pattern >> number) % 2 > 0
        earned = per_row(first.rows, mass * seen * problem.detected[first.cells], m) - cheapest[:, pattern]
        left = mass * ~seen
        hopeful = earned + per_row(first.rows, left * revealed[first.cells], m) > most
        if not hopeful.any():
            continue
        if not looked_at(int(hopeful.sum())):
            return None
        left = left @ last.moves
        gain = left * (problem.detected[last.cells] - missed) * hopeful[last.rows]
        paid = last.covering.price(world.cost, per_row(last.rows, left, m))
        cover = last.covering.best(gain, paid, exact=True)
        worth = earned + per_row(last.rows, left * missed, m) + cover.upper
        better = hopeful & (worth > most)
        most = np.where(better, worth, most)
        seen_best = np.where(better[first.rows], seen, seen_best)
        last_best = np.where(better[last.on_rows], cover.on > 0, last_best)
    found = most > before + slack
    # The cheapest set that sees a pattern: what it has to see is worth more than all prices, what not, a loss as large.
    large = (1.0 + price.sum()) * found[first.rows]
    exactly = first.covering.best(np.where(seen_best, large, -large), price, exact=True).on > 0
    return most, [np.where(found[first.on_rows], exactly, sets[0]), last_best]


def _cheapest(covering: Covering, price: Array, number: IndexArray) -> Array:
    """`[M, 2^Z]`, the least price of a set that sees the entries of each pattern and no others; inf without one.

    Bit b of a pattern says that the entry of a located cell with the `number` b is seen.
    """
    pattern = (covering.covers @ (1 << number)).astype(np.int64)
    place = np.arange(len(pattern)) - np.searchsorted(covering.rows, covering.rows)
    every = np.arange(2 << int(number.max()))
    cheapest = np.full((covering.count, len(every)), np.inf)
    cheapest[:, 0] = 0.0
    for k in range(int(place.max(initial=-1)) + 1):
        pair = np.flatnonzero(place == k)
        row = covering.rows[pair][:, None]
        # With sensor k, patterns become their union with its own; each of the patterns before has one place to go.
        np.minimum.at(cheapest, (row, every | pattern[pair][:, None]), cheapest[row[:, 0]] + price[pair][:, None])
    return cheapest
