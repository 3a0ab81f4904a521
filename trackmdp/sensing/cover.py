"""The best set of sensors that share cells: weighted coverage (theory.md#footprints).

Sensor s reports a target at entry e with probability p_se, independently of the others. A set A is worth

    sum_e g_e b_e(A) - sum_{s in A} c_s,      b_e(A) = 1 - prod_{s in A} (1 - p_se),

g_e the worth of a report. Since b_e(A) <= min(z̄_e, sum_{s in A} p_se), z̄_e the value of b_e with all sensors on, the
linear program

    max  sum_e g_e z_e - sum_s c_s x_s      with  z_e <= sum_s p_se x_s,  0 <= z_e <= z̄_e,  0 <= x_s <= 1

is worth no less than any set (and where no sensor misses, its integer solutions are the sets). Any lambda_e in [0, g_e]
proves

    sum_e z̄_e (g_e - lambda_e) + sum_s max(sum_e p_se lambda_e - c_s, 0)

as an upper bound, for a solution of any solver: so the bounds here hold to rounding. Where g_e < 0, a report is a loss
that a set has to take; the relaxation may leave it out (z_e = 0), which only raises the bound. With a budget, sum_s x_s
<= B, any mu >= 0 takes mu off the gain of each sensor in the second sum, and adds mu B.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import among, per_row, ranks, row_index, summing, with_data
from trackmdp.arrays.types import AnyArray, Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.sensing.choose import TIE, Cover, largest
from trackmdp.sensing.programs import PROVED, integer, relaxed
from trackmdp.sensing.task import Task

_LISTED, _MOST_SETS, _AT_ONCE = 14, 2**22, 2**18
"""Sensors of a row up to which all sets are gone through; sets of all rows, and how many at once."""
_MOST = 2**26
"""Sensors that see the entries of a step, entry by entry: some 5 GB."""
_WORTH_PARTS = 2**13
"""Decisions times candidates from which on it saves time to go on with a part of them."""
_CERTAIN = 1.0 - 2.0**-53
"""Stands for a probability of 1 where its logarithm is needed; all that is left of an entry then is 1e-16."""


@dataclass(frozen=True, eq=False)
class Shared:
    """Decisions about sensors that share entries; methods are those of `Own`.

    Attributes:
        rows, sensors: `[G]`, row and sensor of each decision, in order.
        count: K, rows.
        sees: `[G, E]` CSR, probability that the sensor of a decision reports an entry of its row.
        budget: B, sensors that may be on in a row; None: all.
    """

    rows: IndexArray
    sensors: IndexArray
    count: int
    sees: sparse.csr_array
    budget: int | None

    allowed = None

    @classmethod
    def of(
        cls,
        task: Task,
        rows: IndexArray,
        cells: IndexArray,
        count: int,
        located: IndexArray | None,
    ) -> Shared:
        """See `trackmdp.sensing.decisions.sensing`.

        Raises:
            UserError: there are too many.
        """
        by_cell = task.sees_by_cell
        if (total := int(np.diff(by_cell.indptr)[cells].sum())) > _MOST:
            reach = f"{total:,} pairs of a cell where the target may be and a sensor that covers it"
            raise UserError(
                f"coverage: {reach}, expected at most {_MOST:,}; leave out sensors, or cells that they cover"
            )
        seen = by_cell[cells]
        entry = row_index(seen)
        row, sensor = rows[entry].astype(np.int64), seen.indices
        keep = task.choosable(None if located is None else located[row], sensor)
        data = seen.data
        if keep is not None:
            entry, row, sensor, data = entry[keep], row[keep], sensor[keep], data[keep]
        # Of 9 sensors, the decision (row 2, sensor 5) has the number 2 * 9 + 5 = 23; sorted, they are the decisions.
        numbers, number = np.unique(row * task.total_sensors + sensor, return_inverse=True)
        owner, sensor = np.divmod(numbers, task.total_sensors)
        sees = sparse.csr_array((data, (number, entry)), shape=(len(numbers), len(cells)))
        return cls(owner, sensor, count, sees, task.budget)

    @cached_property
    def perfect(self) -> bool:
        """Whether no sensor misses in its footprint."""
        return bool((self.sees.data == 1.0).all())

    @cached_property
    def _logs(self) -> sparse.csr_array:
        """`[E, G]` log(1 - p)."""
        return with_data(self.sees, np.log1p(-np.minimum(self.sees.data, _CERTAIN))).T.tocsr()

    @cached_property
    def _odds(self) -> sparse.csr_array:
        """`[G, E]` p / (1 - p): factor of the unreported mass that a sensor adds to the reports."""
        p = np.minimum(self.sees.data, _CERTAIN)
        return with_data(self.sees, self.sees.data / (1.0 - p))

    def _unreported(self, on: AnyArray) -> Array:
        """`[E, C]` probability that no sensor of `on` `[G, C]` reports an entry."""
        return np.exp(self._logs @ on.astype(np.float64))

    def report(self, on: AnyArray) -> AnyArray:
        """See `Own`."""
        if on.dtype != np.bool_:
            return 1.0 - self._missed(on)[0][:, None]
        if self.perfect:
            return self.sees.T @ on.astype(np.float64) > 0
        left = self._unreported(on)
        return np.where(left < 1e-15, 1.0, 1.0 - left)

    def slope(self, gain: Array, on: Array) -> Array:
        """See `Own`."""
        # d/dq_s of 1 - prod (1 - p_s q_s) is p_s times the product over the others.
        missed, alone = self._missed(on)
        others = missed[self.sees.indices] / alone
        return with_data(self.sees, self.sees.data * others) @ gain

    def _missed(self, on: Array) -> tuple[Array, Array]:
        """`[E]` probability that no sensor reports, of chances `on` `[G, 1]`; and that each one alone does not."""
        alone = 1.0 - np.minimum(self.sees.data * on[row_index(self.sees), 0], _CERTAIN)
        return np.exp(with_data(self.sees, np.log(alone)).sum(axis=0)), alone

    def gained(self, gain: Array) -> Array:
        """See `Own`."""
        return self.sees @ gain

    def worth(self, on: BoolArray, gain: Array, price: Array) -> Array:
        """`[K, C]` net gain of the sets `on`; each entry's gain is shared by the sensors that may report it."""
        times = np.maximum(self.sees.T @ on.astype(np.float64), 1e-300)
        parts = on * (self.sees @ (gain * self.report(on) / times))
        return self._sums @ (parts - on * price)

    @cached_property
    def _sums(self) -> sparse.csr_array:
        return summing(self.rows, self.count)

    def changes(self, on: BoolArray, gain: Array, price: Array) -> Array:
        """See `Own`."""
        left = gain * self._unreported(on)
        return np.where(on, price - self._odds @ left, self.sees @ left - price)

    def best(
        self, gain: Array, price: Array, on: BoolArray | None = None, *, exact: bool = False
    ) -> BoolArray:
        """See `Own`; found by adding and dropping one sensor at a time, from `on`, from none and from all."""
        price = np.broadcast_to(price, (len(self.rows), gain.shape[1]))
        if exact:
            columns = zip(gain.T, price.T, strict=True)
            return np.stack([self.cover(*each, exact=True).on > 0 for each in columns], axis=1)
        found = self.greedy(gain, price)
        if on is None:
            return found
        start = np.broadcast_to(on, np.broadcast_shapes(on.shape, price.shape))
        return self._better(self._add_drop(start, gain, price), found, gain, price)

    def greedy(self, gain: Array, price: Array) -> BoolArray:
        """`[G, C]` a good set of each row: the better one of the ends of add-drop from none and from all.

        Of sensors that report the same entries alike the cheapest takes part.
        """
        kept = self.distinct(price[:, 0])
        if len(kept) < len(price):
            on = np.zeros(price.shape, bool)
            mark = kept.tobytes()
            if mark not in self._parts:  # prices of a row hardly ever change their order
                self._parts.clear()
                self._parts[mark] = self.some(kept)
            on[kept] = self._parts[mark]._from_both(gain, price[kept])
            return on
        return self._from_both(gain, price)

    @cached_property
    def _parts(self) -> dict[bytes, Shared]:
        """The last of `some` decisions that `greedy` chose from, by their numbers."""
        return {}

    def _from_both(self, gain: Array, price: Array) -> BoolArray:
        """`greedy` of all the decisions."""
        every = self.sees @ np.maximum(gain, 0.0) > price
        # Side by side: of few candidates most of the time goes into the calls.
        starts = np.hstack([np.zeros_like(every), every])
        ends = self._add_drop(starts, np.hstack([gain, gain]), np.hstack([price, price]))
        one, other = np.hsplit(ends, 2)
        return self._better(one, other, gain, price)

    def _better(self, one: BoolArray, other: BoolArray, gain: Array, price: Array) -> BoolArray:
        """Of each row the set that gains more, the first where they gain the same."""
        better = self.worth(other, gain, price) > self.worth(one, gain, price)
        return np.where(better[self.rows], other, one)

    def _add_drop(
        self, on: BoolArray, gain: Array, price: Array, tie: float | None = None
    ) -> BoolArray:
        """Every row takes the one change that gains it most, until none gains more than `tie`.

        With more sensors on than the budget it drops those that cost least to drop.
        """
        if tie is None:
            tie = TIE * float(np.abs(gain).max(initial=0.0) + price.max(initial=0.0))
        first = np.flatnonzero(np.diff(self.rows, prepend=-1))
        lengths = np.diff(first, append=len(self.rows))
        on, place = on.copy(), np.arange(len(self.rows))[:, None]
        while len(first):
            change, over = self.changes(on, gain, price), np.zeros(1, bool)
            if self.budget is not None:
                number = np.add.reduceat(on, first, axis=0, dtype=np.int64)
                full = np.repeat(number >= self.budget, lengths, axis=0)
                change, over = np.where(full & ~on, -np.inf, change), number > self.budget
            best = np.maximum.reduceat(change, first, axis=0)
            tied = np.where(change >= np.repeat(best, lengths, axis=0), place, len(place))
            chosen = np.minimum.reduceat(tied, first, axis=0)  # of several equal ones the first
            gains = (best > tie) | over
            row, column = np.nonzero(gains)
            if not len(row):
                break
            where = chosen[row, column], column
            on[where] = ~on[where]
            # Rows and candidates where nothing gained are settled: once the others are few, only these go on.
            moved, wide = np.flatnonzero(gains.any(axis=1)), np.flatnonzero(gains.any(axis=0))
            if change.size > _WORTH_PARTS and 2 * len(moved) * len(wide) < best.size:
                plans = self.rows[first[moved]]
                kept = np.flatnonzero(among(plans, self.rows)[1])
                entries = np.flatnonzero(np.bincount(self.sees[kept].indices))
                gain, price = (
                    np.broadcast_to(each, (len(each), on.shape[1]))[np.ix_(some, wide)]
                    for each, some in ((gain, entries), (price, kept))
                )
                here, left = np.ix_(kept, wide), self.part(kept, entries, plans)
                on[here] = left._add_drop(on[here], gain, price, tie)
                break
        return on

    def distinct(self, price: Array) -> IndexArray:
        """The cheapest of the decisions that report the same entries alike; no best set needs another."""
        if not self.perfect:  # two sensors at one place see more than one
            return np.arange(len(self.rows))
        order = np.lexsort((price, self._kind))
        return np.sort(order[np.diff(self._kind[order], prepend=-1) > 0])

    def some(self, kept: IndexArray) -> Shared:
        """Some of the decisions, on all entries."""
        return replace(self, rows=self.rows[kept], sensors=self.sensors[kept], sees=self.sees[kept])

    def part(self, kept: IndexArray, entries: IndexArray, rows: IndexArray) -> Shared:
        """See `Own`."""
        place = np.searchsorted(rows, self.rows[kept])
        sees = self.sees[kept][:, entries]
        return Shared(place, self.sensors[kept], len(rows), sees, self.budget)

    @cached_property
    def _kind(self) -> IndexArray:
        """`[G]`, one number for all decisions that see the same entries, 0 ... without gaps."""
        (count, entries), start = self.sees.shape, self.sees.indptr[:-1]
        length, kind = np.diff(self.sees.indptr), np.zeros(count, np.int64)
        for place in range(int(length.max(initial=0))):
            # Decisions alike up to here differ by their next entry; `entries` stands for none.
            entry = np.full(count, entries, np.int64)
            entry[length > place] = self.sees.indices[start[length > place] + place]
            kind = np.unique(kind * (entries + 1) + entry, return_inverse=True)[1]
        return kind

    def cover(self, gain: Array, price: Array, *, exact: bool = False) -> Cover:
        """The linear program of each row, of gains `[E]` and prices `[G]`; sets alone where `exact`.

        All rows make one program, which falls apart into theirs; of those with fractions, few if any, `exact` goes
        through all sets of up to fourteen sensors, and solves the others as integer programs. Where sensors may miss
        all sets are gone through at once; of more than fourteen the sets are good ones, and only the bound is proved.
        """
        # A sensor is in no solution if all its entries together gain no more than its price.
        use = self.distinct(price)
        use = use[self.sees[use] @ np.maximum(gain, 0.0) > price[use]]
        if not exact:
            return self._relaxed(use, gain, price)
        few = np.zeros(self.count, bool) if self.perfect else self._few(use)
        sets, upper = self._of_all(use[few[self.rows[use]]], gain, price)
        if not few.all():
            relaxed = self._relaxed(use[~few[self.rows[use]]], gain, price)
            other, above = self._rounded(relaxed.on, gain, price, relaxed.upper)
            sets, upper = np.where(few[self.rows], sets, other), np.where(few, upper, above)
        seen = self.report(sets[:, None])[:, 0]
        return Cover(sets.astype(np.float64), seen.astype(np.float64), upper)

    def _relaxed(self, use: IndexArray, gain: Array, price: Array) -> Cover:
        """The linear programs, of the decisions `use`."""
        reached = np.bincount(self.sees[use].indices, minlength=len(gain)) > 0
        entries = np.flatnonzero(reached & (gain > 0))
        sees, cost, value = self.sees[use][:, entries], price[use], gain[entries]
        on, upper, most = np.zeros(len(price)), np.zeros(self.count), np.ones(len(entries))
        if len(use):
            if not self.perfect:
                most -= self.some(use)._unreported(np.ones((len(use), 1), bool))[entries, 0]
            limited = self._sums[: 0 if self.budget is None else None, use]
            on[use], worth, mu = relaxed(sees, value, cost, most, limited, self.budget or 0)
            spare = np.zeros(self.count) if self.budget is None else mu
            # The bound of the module's text: of the entries, of the sensors, and of the budget.
            owner = np.zeros(len(entries), np.int64)
            pairs = sees.tocoo()
            owner[pairs.col] = self.rows[use][pairs.row]
            upper = per_row(owner, most * (value - worth), self.count)
            net = sees @ worth - cost - spare[self.rows[use]]
            upper += per_row(self.rows[use], np.maximum(net, 0.0), self.count)
            upper += (self.budget or 0) * spare
        whole = np.ones(len(gain))
        whole[entries] = most
        return Cover(on, np.minimum(on @ self.sees, whole) * (gain > 0), upper)

    def _few(self, use: IndexArray) -> BoolArray:
        """`[K]`, whether all sets of the decisions `use` of a row are gone through."""
        width = np.bincount(self.rows[use], minlength=self.count)
        order = np.argsort(width, kind="stable")
        few = width <= _LISTED
        few[order] &= np.cumsum(2.0 ** width[order]) <= _MOST_SETS
        return few

    def _of_all(self, use: IndexArray, gain: Array, price: Array) -> tuple[BoolArray, Array]:
        """The best of all sets `[G]` of the decisions `use`, and its gain `[K]`."""
        on, most = np.zeros(len(self.rows), bool), np.zeros(self.count)
        width = np.bincount(self.rows[use], minlength=self.count)
        for count in np.unique(width[width > 0]).tolist():
            rows = np.flatnonzero(width == count)
            for some in np.array_split(rows, 1 + (len(rows) << count) // _AT_ONCE):
                these = use[np.isin(self.rows[use], some)].reshape(-1, count)
                on[these], most[some] = self._best_of_all(these, gain, price)
        return on, most

    def _best_of_all(self, these: IndexArray, gain: Array, price: Array) -> tuple[BoolArray, Array]:
        """The same of rows with equally many decisions, `these` `[K, S]`."""
        width = these.shape[1]
        logs = self._logs[:, these.ravel()].tocoo()
        row, sensor = np.divmod(logs.col, width)
        # The entries of a row are numbered from 0; all rows get as many, those that they lack without gain.
        entries, entry = np.unique(logs.row, return_inverse=True)
        owner = np.zeros(len(entries), np.int64)
        owner[entry] = row
        order = np.argsort(owner, kind="stable")
        place = np.empty(len(order), np.int64)
        place[order] = ranks(owner[order])
        shape = (len(these), int(place.max(initial=0)) + 1)
        dense, gains = np.zeros((len(these), width, shape[1])), np.zeros(shape)
        dense[row, sensor, place[entry]] = logs.data
        gains[owner, place] = gain[entries]
        # Set number 5 of three sensors has the first and the third: 5 = 1 + 4.
        sets = (np.arange(2**width)[:, None] >> np.arange(width)) & 1
        if self.budget is not None:
            sets = sets[sets.sum(axis=1) <= self.budget]
        unreported = np.exp(sets.astype(np.float64) @ dense)
        worth = ((1.0 - unreported) @ gains[:, :, None])[:, :, 0] - price[these] @ sets.T
        best = worth.argmax(axis=1)
        return sets[best] > 0, worth[np.arange(len(these)), best]

    def _rounded(
        self, on: Array, gain: Array, price: Array, upper: Array
    ) -> tuple[BoolArray, Array]:
        """Sets `[G]`, and their proved bound `[K]`: those of the linear program, or else of integer programs."""
        column, paid = gain[:, None], price[:, None]
        near = on[:, None] > 0.5
        if self.budget is not None:
            near &= largest(self.rows, on[:, None], self.budget)
        sets = self._better(near, self.greedy(column, paid), column, paid)
        other, upper = sets.copy(), upper.copy()
        left = upper - self.worth(sets, column, paid)[:, 0]
        kept = self.distinct(price)
        if self.perfect:
            unproved = left > PROVED * np.maximum(upper, 1e-3 * np.abs(gain).max(initial=0.0))
            few = self._few(kept[unproved[self.rows[kept]]]) & unproved
            listed, most = self._of_all(kept[few[self.rows[kept]]], gain, price)
            other[few[self.rows], 0] = listed[few[self.rows]]
            upper[few] = np.minimum(upper, most)[few]
            for row in np.flatnonzero(unproved & ~few):
                mine = kept[self.rows[kept] == row]
                other[mine, 0], proved = integer(self.sees[mine], gain, price[mine], self.budget)
                upper[row] = min(upper[row], proved)
        return self._better(sets, other, column, paid)[:, 0], upper
