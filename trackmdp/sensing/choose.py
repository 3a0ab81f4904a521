"""Sensing, in one place: the sensors that may be on in one step, the entries that each sees, and the best set of them.

An *entry* is a place where the target may be after the move of a step, of the plan of one row (a key, or a located
cell); E of them. A *decision* is a pair (row, sensor); G of them. A set is a bool for each decision. With g_e the worth
of seeing the target at entry e and b_e(A) the probability that set A reports it there, the best set of a row is

    max over A  sum_e g_e b_e(A)  -  sum of the prices of A.

Where one sensor decides each entry (`Own`: every sensor covers the cell of its number) the sum falls apart, and a
sensor is on iff its gains exceed its price. Where sensors share cells (`Shared`) it is weighted coverage; see `cover`.

All arrays are columns `[E, C]` and `[G, C]`: C candidates are worked on at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, ranks, summing
from trackmdp.arrays.types import AnyArray, Array, BoolArray, IndexArray
from trackmdp.sensing.task import Task

TIE = 1e-12
"""Relative slack of a threshold: gains equal to a price but for rounding count as equal to it."""


def largest(rows: IndexArray, net: Array, count: int) -> BoolArray:
    """`[G, C]`, the `count` decisions of each row with the largest `net` `[G, C]`, of equal ones the first."""
    order = np.argsort(-net, axis=0, kind="stable")
    by_row = np.argsort(rows[order], axis=0, kind="stable")
    rank = np.empty(net.shape, np.int64)
    ranked = np.take_along_axis(order, by_row, axis=0)
    np.put_along_axis(rank, ranked, ranks(rows)[:, None], axis=0)
    return rank < count


@dataclass(frozen=True)
class Cover:
    """Best sets of all rows, or solutions of linear programs that stand for them.

    Attributes:
        on: `[G]`, whether each decision is on; of linear programs its share.
        seen: `[E]`, probability of a report at each entry.
        upper: `[K]`, proved: no set of the row gains more.
    """

    on: AnyArray
    seen: AnyArray
    upper: Array


@dataclass(frozen=True, eq=False)
class Own:
    """Each entry is seen by the sensor of its own cell.

    Two entries of one plan and one cell, with different modes, are decided together. Example: a target that may be in
    cell 5 with heading 0 or 1, or in cell 6, has three entries, the decisions 0 0 1 and the sensors 5 6.

    Attributes:
        rows, sensors: `[G]`, row and sensor of each decision, in order.
        count: K, rows.
        group: `[E]` the decision about each entry; None: entry e is decided by decision e.
        chance: `[E, 1]` p_d there; None: 1 everywhere.
        allowed: `[G, 1]`, the decisions that may be on: which sensors exist and lie in the window; None: all.
        budget: sensors that may be on in a row; None: all.
    """

    rows: IndexArray
    sensors: IndexArray
    count: int
    group: IndexArray | None
    chance: Array | None
    allowed: BoolArray | None
    budget: int | None

    @classmethod
    def of(
        cls,
        task: Task,
        rows: IndexArray,
        cells: IndexArray,
        count: int,
        located: IndexArray | None,
        *,
        distinct: bool,
    ) -> Own:
        """See `sensing`."""
        chance = None if task.perfect else task.detection[cells][:, None]
        group = None
        if not distinct:
            codes = rows.astype(np.int64) * task.num_cells + cells
            if not (np.diff(codes) > 0).all():
                codes, group = np.unique(codes, return_inverse=True)
                rows, cells = np.divmod(codes, task.num_cells)
        allowed = task.choosable(None if located is None else located[rows], cells)
        allowed = None if allowed is None else allowed[:, None]
        return cls(rows, cells, count, group, chance, allowed, task.budget)

    def report(self, on: AnyArray) -> AnyArray:
        """`[E, C]` probability that the set `on` `[G, C]` reports a target there; bool where no sensor misses.

        Or `on` `[G, 1]` are the probabilities with which the sensors are on, each independently of the others.
        """
        there = on if self.group is None else on[self.group]
        return there if self.chance is None else there * self.chance

    def slope(self, gain: Array, on: Array) -> Array:  # noqa: ARG002
        """`[G, 1]` derivatives of the sum of `gain` `[E, 1]` times `report` by the probabilities `on` `[G, 1]`."""
        return self.gained(gain)

    def part(self, kept: IndexArray, entries: IndexArray, rows: IndexArray) -> Own:
        """Some of the decisions, on some of the entries.

        Args:
            kept: `[G']` decisions, all those of some rows.
            entries: `[E']` entries of the same rows, in order.
            rows: these rows, which become 0, 1, ...
        """
        group = self.group
        return Own(
            np.searchsorted(rows, self.rows[kept]),
            self.sensors[kept],
            len(rows),
            None if group is None else np.searchsorted(kept, group[entries]),
            None if self.chance is None else self.chance[entries],
            None if self.allowed is None else self.allowed[kept],
            self.budget,
        )

    def gained(self, gain: Array) -> Array:
        """`[G, C]`, sums of `gain` `[E, C]` over the entries of each sensor, times its probability of a report."""
        gain = gain if self.chance is None else gain * self.chance
        return gain if self.group is None else self._sums @ gain

    @cached_property
    def _sums(self) -> sparse.csr_array:
        assert self.group is not None
        return summing(self.group, len(self.rows))

    def best(
        self,
        gain: Array,
        price: Array,
        on: BoolArray | None = None,  # noqa: ARG002
        *,
        exact: bool = False,  # noqa: ARG002
    ) -> BoolArray:
        """`[G, C]` the set that gains most, where seeing each entry is worth `gain` `[E, C]`.

        Args:
            gain: of seeing a target there, weighted by its mass.
            price: `[G, C]`, of each decision.
            on: `[G, C]` a set that the one found is no worse than.
            exact: whether shared sensors are chosen by linear and integer programs, not by greedy and add-drop.
        """
        # Strict: an entry without mass is never sensed, not even by a sensor that costs nothing.
        gained = self.gained(gain)
        chosen: BoolArray = gained > price
        chosen = chosen if self.allowed is None else chosen & self.allowed
        if self.budget is not None:
            some = np.flatnonzero(chosen.any(axis=1))  # few, and to sort all takes long
            net = np.where(chosen, gained - price, -np.inf)[some]
            chosen[some] &= largest(self.rows[some], net, self.budget)
        return chosen

    def cover(self, gain: Array, price: Array, *, exact: bool = False) -> Cover:  # noqa: ARG002
        """The best sets, and what they gain, of `gain` `[E]` and prices `[G]`; `exact`: sets, not shares."""
        on = self.best(gain[:, None], price[:, None])
        net = (self.gained(gain[:, None]) - price[:, None]) * on
        upper = per_row(self.rows, net[:, 0], self.count)
        return Cover(on[:, 0], self.report(on)[:, 0], upper)

    def changes(self, on: BoolArray, gain: Array, price: Array) -> Array:
        """`[G, C]` gain of switching each sensor over, all others as they are."""
        net = self.gained(gain) - price
        return np.where(on, -net, net)
