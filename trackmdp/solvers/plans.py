"""Plans of sets and their candidates: one or two cells of one set changed, all later sets chosen anew, and then judged.

The candidates of all rows (located cells, or keys) are worked on together, as columns: `[E, C]` has a row for each
entry of a layer (a pair of row and possible position) and a column for each of the C = 33 candidates of that row. With
E_t entries in layer t and Z successors per cell, a sweep over all H = t_max + 1 steps takes 2 C Z (E_0 + ... + E_H-1)
multiplications, and the candidates of the H - 1 steps take about three sweeps each; E_t is at most M min(Z^t, M). Some
3 H + 10 arrays of 8 C E bytes are alive at once, E being the largest E_t of a part: rows are gone through in parts, so
that one array holds about `MOST_NUMBERS` numbers at most, or those of one row.

Where a row holds several entries of one cell (`keyed_exchange`) one sensor decides them together, a group, and is paid
for once. Example: a key whose target may have moved to cell 5 with heading 0 or 1, or to cell 6: three entries, the
groups 0 0 1.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.solvers.renewal import IndexArray, per_row, row_index
from trackmdp.world.model import Array, BoolArray

MOST_NUMBERS = 2**17
"""Numbers in one array of a part, 1 MB: larger parts leave the caches, and took twice the time."""
SINGLES, PAIRED = 12, 7
"""Cells of one set that are flipped alone, and how many of these in pairs: those nearest to the other choice first."""
LATER_SWEEPS, ALL_SWEEPS = 1, 2
"""Sweeps over the sets after the flip alone, then over all sets. More of the first gained nothing on drifts and walks;
with one of the second, regrets of .001 to .004 are left there."""


def _candidates() -> BoolArray:
    """`[SINGLES + 1, C]` whether the cell of each rank is flipped in each candidate; the last row is for all others."""
    pairs = [*((rank,) for rank in range(SINGLES)), *itertools.combinations(range(PAIRED), 2)]
    flipped = np.zeros((SINGLES + 1, len(pairs)), dtype=bool)
    for candidate, ranks in enumerate(pairs):
        flipped[list(ranks), candidate] = True
    return flipped


FLIPPED = _candidates()


@dataclass(frozen=True)
class ChainStep:
    """Where the target may be after a free choice's move, E entries in order of their rows, in G groups.

    Attributes:
        rows: `[E]`, which row's plan, 0 ... K - 1.
        moves: `[E_before, E]`, probability of each move.
        detected: `[E]`, what locating the target there is worth.
        chance: `[E]`, p_d of the sensor there.
        price: `[G]`, of the sensor of each group.
        stay: `[E_before]`, probability that the target is still there after the move; None: the sums of `moves`.
        group: `[E]`, the sensor that decides it; groups are in order of their rows. None: each entry has its own.
        allowed: `[E]`, which of these sensors can be chosen; None: all.
    """

    rows: IndexArray
    moves: sparse.csr_array
    detected: Array
    chance: Array
    price: Array
    stay: Array | None = None
    group: IndexArray | None = None
    allowed: BoolArray | None = None


@dataclass(frozen=True)
class Chains:
    """The searches from K rows.

    Attributes:
        rows: `[E_0]`, the row of each entry before any move, in order.
        mass: `[E_0]`, its weight.
        steps: of the free choices.
        missed: `[E]`, what is left where the target was missed in the last step.
    """

    rows: IndexArray
    mass: Array
    steps: list[ChainStep]
    missed: Array


def parts(entries: IndexArray) -> Iterator[slice]:
    """Ranges of rows with so many `entries` `[K]` each, as many at once as `MOST_NUMBERS` allows."""
    # Rows with 40, 50 and 30 entries, and room for 100: their sums 40, 90, 120 fall into the parts 0, 0, 1.
    number = (np.cumsum(entries) - 1) // max(1, MOST_NUMBERS // FLIPPED.shape[1])
    ends = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(entries)]
    yield from (slice(low, high) for low, high in itertools.pairwise(ends) if high > low)


def exchanged_parts(
    sets: list[BoolArray], chains: Iterable[tuple[Chains, Sequence[IndexArray]]], *, settle: bool = False
) -> list[BoolArray]:
    """Plans per step that are worth no less than `sets` to any row; `sets` is left as it is.

    Args:
        sets: `[G]` per step.
        chains: the searches, in parts: each with the places of its groups in `sets`, per step.
        settle: whether plans may not be where ascent by itself ends, and are brought there first.
    """
    improved = [on.copy() for on in sets]
    for part, owners in chains:
        plans = Plans(part).exchange([on[owner] for on, owner in zip(improved, owners, strict=True)], settle=settle)
        for on, owner, plan in zip(improved, owners, plans, strict=True):
            on[owner] = plan
    return improved


class Plans:
    """The plans of some rows and their candidates, the worth of locating the target given."""

    def __init__(self, chains: Chains) -> None:
        steps, count = chains.steps, int(chains.rows.max(initial=-1)) + 1
        self.length = len(steps)
        # Columns `[E, 1]` to stand beside candidates `[E, C]`. Index 0, the layer before any move, is filled with what
        # is not used, so that step t has the index t everywhere.
        self.rows = [chains.rows, *(step.rows for step in steps)]
        self.moves = [sparse.csr_array((0, 0)), *(step.moves for step in steps)]
        self.back = [sparse.csr_array(moves.T) for moves in self.moves]
        self.sums = [summing(rows, count) for rows in self.rows]
        self.stay = [(_sums(step.moves) if step.stay is None else step.stay)[:, None] for step in steps]
        columns = ([each[:, None] for each in (s.detected, s.chance, s.price)] for s in steps)
        self.detected, self.reports, self.price = ([np.zeros((0, 1)), *each] for each in zip(*columns, strict=True))
        self.allowed = [None, *(None if step.allowed is None else step.allowed[:, None] for step in steps)]
        groups = [None, *(step.group for step in steps)]
        # Group of each entry, and first entry of each group.
        self.group = [slice(None) if group is None else group for group in groups]
        self.first = [slice(None) if each is None else np.unique(each, return_index=True)[1] for each in groups]
        self.adding = [None if each is None else summing(each, each.max(initial=-1) + 1) for each in groups]
        # A group is paid for once: its first entry bears the price, the others none.
        self.cost = [np.zeros((len(rows), 1)) for rows in self.rows]
        for t in range(1, self.length + 1):
            self.cost[t][self.first[t]] = self.price[t]
        self.missed, self.mass = chains.missed[:, None], chains.mass[:, None]

    def _together(self, t: int, each: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """`[G, C]` sums over the entries of each group."""
        adding = self.adding[t]
        return each if adding is None else adding @ each

    def exchange(self, sets: list[BoolArray], *, settle: bool) -> list[BoolArray]:
        """The better plans `[G]` per step, from the `sets` of the same rows; the last set is always a best answer."""
        plan = [on[self.group[t], None] for t, on in enumerate(sets, start=1)]
        worth = self.worth(plan)
        if settle:
            plan, worth = self.better(plan, worth, self.ascend(plan, self.mass, 0, ALL_SWEEPS))
        for step in range(1, self.length):
            mass = self.pushed(plan, step)
            first = plan[step - 1] ^ FLIPPED[self.ranks(step, plan, mass)]
            # The sets before the flip are held in these sweeps, so that they need no more than the mass that is left.
            later = self.ascend(plan[step:], self.missing(step, first, mass), step, LATER_SWEEPS)
            candidates = self.ascend([*plan[: step - 1], first, *later], self.mass, 0, ALL_SWEEPS)
            plan, worth = self.better(plan, worth, candidates)
        return [self._together(t, on)[:, 0] > 0 for t, on in enumerate(plan, start=1)]

    def better(self, plan: list[BoolArray], worth: Array, candidates: list[BoolArray]) -> tuple[list[BoolArray], Array]:
        """The best candidate of each located cell in place of its plan, if it is worth more; and what that is worth."""
        found = self.worth(candidates)
        best = found.argmax(axis=1)[:, None]
        reached = np.take_along_axis(found, best, axis=1)
        gains = reached > worth + 1e-10 * (1.0 + np.abs(worth))
        each = (np.broadcast_to(on, (len(on), found.shape[1])) for on in candidates)
        chosen = [
            np.where(gains[rows], np.take_along_axis(on, best[rows], axis=1), old)
            for on, old, rows in zip(each, plan, self.rows[1:], strict=True)
        ]
        return chosen, np.where(gains, reached, worth)

    def pushed(self, plan: list[BoolArray], step: int) -> Array:
        """`[E, 1]` undetected mass at `step`, before its set is sensed."""
        mass = self.mass
        for t in range(1, step):
            mass = self.missing(t, plan[t - 1], self.back[t] @ mass)
        return self.back[step] @ mass

    def ranks(self, step: int, plan: list[BoolArray], mass: Array) -> IndexArray:
        """`[E]` how near its group's choice at `step` is to the other one, 0 the nearest; SINGLES: never."""
        gain = self.gains(plan[step - 1 :], step - 1)[0]
        gained, there = self._together(step, mass * gain), self._together(step, mass)
        row = self.rows[step][self.first[step]]
        price = self.price[step] * (self.sums[step] @ mass)[row]
        # Free sensors come last: there is no price that would make them nearly worth leaving out.
        margin = np.divide(np.abs(gained - price), price, out=np.full_like(gained, np.inf), where=price > 0)[:, 0]
        possible = there[:, 0] > 0
        rank = ranked(row, margin, possible)
        if (allowed := self.allowed[step]) is not None:
            possible &= allowed[:, 0]
        return np.where(possible, np.minimum(rank, SINGLES), SINGLES)[self.group[step]]

    def undetected(self, t: int, on: BoolArray, later: Array, gain: Array) -> Array:
        """W_t `[E, C]` on the layer before step t, when the set `on` is followed by `later`, W_t+1, where it misses."""
        # The recursion of `InnerProblem.undetected`, for a column of each candidate.
        paid = self.sums[t] @ (on * self.cost[t])
        gross = self.moves[t] @ (later + np.where(on, gain, 0.0))
        return gross - paid[self.rows[t - 1]] * self.stay[t - 1]

    def gain(self, t: int, later: Array) -> Array:
        """`[E, C]` what sensing a target that is there at step t gains over `later`."""
        return self.reports[t] * (self.detected[t] - later)

    def gains(self, sets: list[BoolArray], since: int) -> list[Array]:
        """`gain` at each step after `since`, when `sets` go on; the first of these is not looked at."""
        later, gains = self.missed, [self.gain(self.length, self.missed)]
        for t, on in zip(range(self.length, since + 1, -1), reversed(sets), strict=False):
            later = self.undetected(t, on, later, gains[0])
            gains.insert(0, self.gain(t - 1, later))
        return gains

    def missing(self, t: int, on: BoolArray, mass: Array) -> Array:
        """`[E, C]` the `mass` at step t that is still undetected after the set `on`."""
        return mass * (1.0 - on * self.reports[t])

    def worth(self, sets: list[BoolArray]) -> Array:
        """`[K, C]` what whole plans earn from each located cell."""
        later = self.missed
        for t, on in zip(range(self.length, 0, -1), reversed(sets), strict=True):
            later = self.undetected(t, on, later, self.gain(t, later))
        return self.sums[0] @ (self.mass * later)

    def ascend(self, sets: list[BoolArray], mass: Array, since: int, sweeps: int) -> list[BoolArray]:
        """At most `sweeps` times, the best set at each step after `since` given the others; see `InnerProblem.ascend`.

        Args:
            sets: `[E, C]` or, where all candidates have the same, `[E, 1]` per step after `since`.
            mass: `[E, C]` or `[E, 1]`, undetected mass on the layer `since`.
            since: the step whose set, and those before it, are held.
            sweeps: passes over the steps.
        """
        for _ in range(sweeps):
            now, chosen = mass, []
            for t, gain in enumerate(self.gains(sets, since), start=since + 1):
                now = self.back[t] @ now
                on = self.best(t, now, gain)
                chosen.append(on)
                now = self.missing(t, on, now)
            if all((new == old).all() for new, old in zip(chosen, sets, strict=True)):
                break
            sets = chosen
        return sets

    def best(self, t: int, mass: Array, gain: Array) -> BoolArray:
        """`[E, C]` the best set at step t, where sensing `mass` there gains `gain` times as much."""
        price = self.price[t] * (self.sums[t] @ mass)[self.rows[t][self.first[t]]]
        on, allowed = self._together(t, mass * gain) > price, self.allowed[t]
        return (on if allowed is None else on & allowed)[self.group[t]]


def _sums(moves: sparse.csr_array) -> Array:
    return per_row(row_index(moves), moves.data, moves.shape[0])


def summing(index: IndexArray, count: int) -> sparse.csr_array:
    """`[count, E]` that sums the entries of each index, whatever the number of columns (`per_row` is for one)."""
    return sparse.csr_array((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))


def ranked(rows: IndexArray, margin: Array, possible: BoolArray) -> IndexArray:
    """`[E]` place of each entry among those of its row, least margin first, what is not possible last."""
    order = np.lexsort((margin, ~possible, rows))
    # Entries are in order of their rows, and ranks run from 0 within each: with rows 0 0 1 1 1 the first entries
    # are 0 0 2 2 2, and the ranks of `order` 0 1 0 1 2.
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.searchsorted(rows, rows)
    return rank
