"""Which sensors to switch on where each covers several cells: weighted coverage, for all located cells at once.

Of one located cell x a set A is worth sum of g_j over the cells j that A covers, less the prices of its sensors; g_j is
what it gains to see the target in j (`prediction`, `search`, `bounds`). With a sensor in each cell the sum falls apart,
and a sensor is on iff g_j > c_j; with footprints the sensors of a cell share it:

    max  sum_j g_j z_j - sum_s c_s x_s      with  z_j <= sum of x_s over the sensors s of j,  0 <= z_j, x_s <= 1.

Its value with fractions allowed is no less than that of any set (the LP bound). Any lambda_j in [0, g_j] proves

    sum_j (g_j - lambda_j) + sum_s max(sum_{j of s} lambda_j - c_s, 0)

as an upper bound, whatever solver it came from: so the bounds here hold to rounding. Where g_j < 0, seeing the
target in j is a loss that a set covering j has to take; the relaxation may leave it out (z_j = 0), which only raises
the bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.world.model import Array, BoolArray, Task

TIE = 1e-12
"""Relative slack of a threshold: gains equal to a price but for rounding are sensed, the same way each time."""
_PROVED = 1e-9
"""Part of what could be gained up to which a set counts as the best: rounding of linear and integer programs."""
_SCALE = 1e5
"""The largest gain as an integer program is told it."""
_MOST = 2**26
"""Sensors that see the entries of a layer, entry by entry: some 5 GB."""


@dataclass(frozen=True)
class Offer:
    """What sensing gains and costs in one step, for all located cells.

    Attributes:
        gain: `[E]`, what it gains to see the target at each entry (located cell, possible cell).
        price: `[S]`, of each sensor.
        charge: `[M]`, what prices are multiplied by, for each located cell.
        ties: whether a sensor that gains its very price is on.
    """

    gain: Array
    price: Array
    charge: Array
    ties: bool = False


@dataclass(frozen=True)
class Chosen:
    """The sensors on, as pairs of located cell and sensor `[Q]`, and the entries that they see `[E]` bool."""

    rows: IndexArray
    sensors: IndexArray
    seen: BoolArray


def best_sets(
    task: Task, rows: IndexArray, cells: IndexArray, offer: Offer, allowed: BoolArray | None = None
) -> Chosen:
    """The set that gains most in each row; by greedy and add-drop (`Covering.greedy`) where sensors have footprints.

    Args:
        task: its sensors.
        rows: `[E]` located cell of each entry, in order.
        cells: `[E]` where the target may be.
        offer: gains and prices.
        allowed: `[E]`, which of the sensors at `cells` can be chosen; None: all.
    """
    covering = Covering.of(task, rows, cells)
    if covering is not None:
        price = offer.price[covering.sensors] * offer.charge[covering.rows] * (1.0 - TIE if offer.ties else 1.0)
        on = covering.greedy(offer.gain, price)
        return Chosen(covering.rows[on], covering.sensors[on], covering.seen(on))
    price = offer.price[cells] * offer.charge[rows]
    on = offer.gain >= price * (1.0 - TIE) if offer.ties else offer.gain > price
    on = on if allowed is None else on & allowed
    return Chosen(rows[on], cells[on], on)


@dataclass(frozen=True)
class Cover:
    """Solutions of the coverage problems of all located cells, fractions allowed.

    Attributes:
        on: `[P]`, share of each pair (located cell, sensor).
        seen: `[E]`, share of each entry that is seen.
        upper: `[M]`, proved: no set gains more.
    """

    on: Array
    seen: Array
    upper: Array


@dataclass(frozen=True)
class Covering:
    """The sensors that may see the target, for each located cell.

    Attributes:
        count: M, located cells.
        rows, sensors: `[P]`, located cell and sensor of each pair, in order.
        covers: `[P, E]` 1.0 where the sensor of a pair covers the cell of an entry of the same located cell.
    """

    count: int
    rows: IndexArray
    sensors: IndexArray
    covers: sparse.csr_array

    @classmethod
    def of(cls, task: Task, rows: IndexArray, cells: IndexArray) -> Covering | None:
        """Of the entries (`rows`, `cells`) `[E]`; None where each sensor covers its own cell, and needs no problem.

        Raises:
            UserError: there are too many.
        """
        if task.coverage is None:
            return None
        if (total := int(task.coverage.degree[cells].sum())) > _MOST:
            reach = f"{total:,} pairs of a cell where the target may be and a sensor that covers it"
            raise UserError(
                f"coverage: {reach}, expected at most {_MOST:,}; leave out sensors, or cells that they cover"
            )
        sensors = task.coverage.by_cell[cells]
        entry = np.repeat(np.arange(len(cells)), np.diff(sensors.indptr))
        # Of 9 sensors, the pair (located cell 2, sensor 5) has the number 2 * 9 + 5 = 23; sorted, they are the pairs.
        number = rows[entry].astype(np.int64) * task.total_sensors + sensors.indices
        pairs, pair = np.unique(number, return_inverse=True)
        owner, sensor = np.divmod(pairs, task.total_sensors)
        shape = (len(pairs), len(cells))
        covers = sparse.csr_array((np.ones(len(entry)), (pair, entry)), shape=shape)
        return cls(task.num_cells, owner, sensor, covers)

    def seen(self, on: BoolArray) -> BoolArray:
        """`[E]`, the entries that the pairs `on` `[P]` see."""
        return on.astype(np.float64) @ self.covers > 0

    def price(self, cost: Array, charge: Array) -> Array:
        """`[P]`, from the sensors' prices `[S]` and what they are multiplied by `[M]`."""
        return cost[self.sensors] * charge[self.rows]

    def worth(self, on: BoolArray, gain: Array, price: Array) -> Array:
        """`[M]`, what the sets `on` `[P]` gain."""
        return per_row(self.rows, on * (self.covers @ self._first(on, gain)) - on * price, self.count)

    def _first(self, on: BoolArray, gain: Array) -> Array:
        """`[E]`, the gain of each entry seen, shared out among the sensors that see it."""
        times = on.astype(np.float64) @ self.covers
        return np.divide(gain, times, out=np.zeros_like(gain), where=times > 0)

    def distinct(self, price: Array) -> IndexArray:
        """Of the pairs that cover the same entries the cheapest, the first of several: no best set needs another."""
        order = np.lexsort((price, self._kind))
        return np.sort(order[np.diff(self._kind[order], prepend=-1) > 0])

    def part(self, pairs: IndexArray) -> Covering:
        """Some of the pairs `[P]`."""
        return Covering(self.count, self.rows[pairs], self.sensors[pairs], self.covers[pairs])

    @cached_property
    def _kind(self) -> IndexArray:
        """`[P]`, one number for all pairs that cover the same entries, 0 ... without gaps."""
        (pairs, entries), start, length = self.covers.shape, self.covers.indptr[:-1], np.diff(self.covers.indptr)
        kind = np.zeros(pairs, dtype=np.int64)
        for place in range(int(length.max(initial=0))):
            # Pairs alike up to here are told apart by their next entry; `entries` stands for none.
            entry = np.full(pairs, entries, dtype=np.int64)
            entry[length > place] = self.covers.indices[start[length > place] + place]
            kind = np.unique(kind * (entries + 1) + entry, return_inverse=True)[1]
        return kind

    def greedy(self, gain: Array, price: Array) -> BoolArray:
        """`[P]`, a good set for each located cell: by adding and dropping one sensor at a time, from none and from all.

        In both passes every located cell takes the one change that gains it most, until none gains; the better of the
        two ends is kept. Of sensors that cover the same entries the cheapest takes part.
        """
        kept = self.distinct(price)
        if len(kept) < len(price):
            on = np.zeros(len(price), dtype=bool)
            on[kept] = self.part(kept).greedy(gain, price[kept])
            return on
        none = self._add_drop(np.zeros(len(price), dtype=bool), gain, price)
        every = self._add_drop(self.covers @ np.maximum(gain, 0.0) > price, gain, price)
        return self._better(none, every, gain, price)

    def improve(self, on: BoolArray, gain: Array, price: Array) -> BoolArray:
        """`[P]`, as `greedy`, and from `on` as well: no worse than that."""
        return self._better(self._add_drop(on, gain, price), self.greedy(gain, price), gain, price)

    def _add_drop(self, on: BoolArray, gain: Array, price: Array) -> BoolArray:
        tie = TIE * float(np.abs(gain).max(initial=0.0) + price.max(initial=0.0))
        first = np.flatnonzero(np.diff(self.rows, prepend=-1))
        on = on.copy()
        while len(first):
            times = on.astype(np.float64) @ self.covers
            # A sensor that is off would see what none sees yet; one that is on alone sees what is seen once.
            added, dropped = (self.covers @ (gain * (times == seen)) - price for seen in (0, 1))
            change = np.where(on, -dropped, added)
            best = np.maximum.reduceat(change, first)
            where = np.flatnonzero(change >= np.repeat(best, np.diff(first, append=len(change))))
            # of several equal ones the first of each located cell
            where = where[np.diff(self.rows[where], prepend=-1) > 0]
            where = where[change[where] > tie]
            if not len(where):
                break
            on[where] = ~on[where]
        return on

    def best(self, gain: Array, price: Array, *, exact: bool = False) -> Cover:
        """The coverage problem of each located cell with fractions allowed; sets alone where `exact`.

        All located cells make one LP, which falls apart into theirs; `exact` solves those whose solution has fractions,
        few if any, as integer programs.
        """
        # A sensor whose cells together gain no more than its price is in no solution, of fractions or not.
        use = self.distinct(price)
        use = use[self.covers[use] @ np.maximum(gain, 0.0) > price[use]]
        entries = np.flatnonzero((np.bincount(self.covers[use].indices, minlength=len(gain)) > 0) & (gain > 0))
        covers, cost, value = self.covers[use][:, entries], price[use], gain[entries]
        on, upper = np.zeros(len(price)), np.zeros(self.count)
        if len(use):
            on[use], prices = _relaxed(covers, value, cost)
            # The bound of the module's text: what its entries gain over their prices, and its sensors over their own.
            pairs = covers.tocoo()
            owner = np.zeros(len(entries), dtype=np.int64)
            owner[pairs.col] = self.rows[use][pairs.row]
            upper = per_row(owner, value - prices, self.count)
            upper += per_row(self.rows[use], np.maximum(covers @ prices - cost, 0.0), self.count)
        if exact:
            sets, upper = self._rounded(on, gain, price, upper)
            return Cover(sets.astype(np.float64), self.seen(sets).astype(np.float64), upper)
        return Cover(on, np.minimum(on @ self.covers, 1.0) * (gain > 0), upper)

    def _rounded(self, on: Array, gain: Array, price: Array, upper: Array) -> tuple[BoolArray, Array]:
        """Sets `[P]`, and what is proved of them `[M]`: those of the LP, or else of integer programs."""
        sets = self._better(on > 0.5, self.greedy(gain, price), gain, price)
        other, upper = sets.copy(), upper.copy()
        left = upper - self.worth(sets, gain, price)
        kept = self.distinct(price)
        for row in np.flatnonzero(left > _PROVED * np.maximum(upper, 1e-3)):
            mine = kept[self.rows[kept] == row]
            other[mine], proved = _integer(self.covers[mine], gain, price[mine])
            upper[row] = min(upper[row], proved)
        return self._better(sets, other, gain, price), upper

    def _better(self, one: BoolArray, other: BoolArray, gain: Array, price: Array) -> BoolArray:
        """Of each located cell the set that gains more, the first where they gain the same."""
        better = self.worth(other, gain, price) > self.worth(one, gain, price)
        return np.where(better[self.rows], other, one)


def _relaxed(covers: sparse.csr_array, gain: Array, price: Array) -> tuple[Array, Array]:
    """Shares `[P]` of the LP, and lambda `[E]` in [0, gain]: what each entry's being covered is worth."""
    p, e = covers.shape
    # Minimise price x - gain z; z_e - (covers^T x)_e <= 0.
    constraint = sparse.hstack([-covers.T, sparse.eye_array(e)], format="csr")
    from scipy.optimize import linprog  # a tenth of a second to load, and most worlds have no footprints

    found = linprog(np.concatenate([price, -gain]), A_ub=constraint, b_ub=np.zeros(e), bounds=(0, 1), method="highs")
    if found.status != 0:  # never seen; all on and no prices is a bound as well
        return np.ones(p), np.zeros(e)
    return np.clip(found.x[:p], 0.0, 1.0), np.clip(-found.ineqlin.marginals, 0.0, gain)


def _integer(covers: sparse.csr_array, gain: Array, price: Array) -> tuple[BoolArray, float]:
    """The best set `[P]` of one located cell, and what is proved of it."""
    used = np.flatnonzero(np.diff(covers.tocsc().indptr))
    covers, gain = covers[:, used], gain[used]
    p, e = covers.shape
    # z_e = 1 iff some sensor of e is on: z_e <= sum of x_s; and x_s <= z_e, which binds where seeing e is a loss.
    pairs = covers.tocoo()
    loss = gain[pairs.col] < 0
    sensor, entry = pairs.row[loss], pairs.col[loss]
    count = np.arange(len(sensor))
    forced = sparse.csr_array(
        (np.repeat([1.0, -1.0], len(count)), (np.tile(count, 2), np.concatenate([sensor, p + entry]))),
        shape=(len(count), p + e),
    )
    union = sparse.hstack([-covers.T, sparse.eye_array(e)], format="csr")
    # HiGHS stops once the best set and its bound are within 1e-6: of numbers this much larger that is nothing.
    scale = _SCALE / max(float(gain.max(initial=0.0)), 1e-300)
    from scipy.optimize import Bounds, LinearConstraint, milp  # as above

    found = milp(
        scale * np.concatenate([price, -gain]),
        constraints=LinearConstraint(sparse.vstack([union, forced], format="csr"), ub=0.0),
        integrality=np.concatenate([np.ones(p), np.zeros(e)]),
        bounds=Bounds(0, 1),
        options={"mip_rel_gap": 0.0},
    )
    if found.x is None:
        return np.zeros(p, dtype=bool), np.inf
    return found.x[:p] > 0.5, float(-found.mip_dual_bound) / scale * (1.0 + _PROVED)
