"""Plans of sets, the worth of a detection given: forward-and-backward sweeps over many candidates at once.

A plan belongs to a row: a key, or a located cell. The sets before step t give the undetected mass m_t, the sets after
it W_t, the worth of going on with the target there, undetected; and the best set of step t is a choice (`choose`) of
gains m_t (r + V - W_t). Sweeps end where no change of one step's set gains (Brown 1980, Washburn 1983;
theory.md#search).

Candidates of all rows are worked on together, as columns: `[E, C]` has a row for each entry of a step and a column for
each of the C candidates of its plan, `[G, C]` one for each decision. Step t has the index t; index 0 is the start.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import summing, with_data
from trackmdp.arrays.types import AnyArray, Array, BoolArray, IndexArray
from trackmdp.policies.table import SetTable
from trackmdp.sensing.decisions import Decisions


@dataclass(frozen=True, eq=False)
class Turn:
    """One free choice, for all K rows.

    Attributes:
        before, rows: `[E_before]` and `[E]`, row of each entry before the move and after it.
        moves: `[E_before, E]`, probability of each move.
        stay: `[E_before]`, probability that the target is still in the grid after the move.
        choice: the decisions about the entries.
        price: `[G]`, of the sensor of each decision.
    """

    before: IndexArray
    rows: IndexArray
    moves: sparse.csr_array
    stay: Array
    choice: Decisions
    price: Array

    @cached_property
    def back(self) -> sparse.csr_array:
        """`[E, E_before]`, the moves the other way round."""
        return sparse.csr_array(self.moves.T)

    @cached_property
    def starts(self) -> sparse.csr_array:
        """`[K, E_before]`, sums over the entries of each row before the move."""
        return summing(self.before, self.choice.count)

    @cached_property
    def sums(self) -> sparse.csr_array:
        """`[K, E]`, the same after it."""
        return summing(self.rows, self.choice.count)

    @cached_property
    def pay(self) -> sparse.csr_array:
        """`[K, G]`, prices of the decisions of each row, which are in order."""
        return with_data(summing(self.choice.rows, self.choice.count), self.price)


def sets_of(choices: Iterable[Decisions], policy: SetTable, plans: IndexArray) -> list[BoolArray]:
    """`[G, 1]` for each free choice, the sets of a policy that does not draw; its `plans` `[K]` are the rows'."""
    return [
        policy.chosen(n, plans[each.rows], each.sensors)[:, None] > 0
        for n, each in enumerate(choices)
    ]


def sensed(
    choices: Iterable[Decisions], sets: Iterable[BoolArray], plans: IndexArray
) -> list[tuple[IndexArray, IndexArray]]:
    """For each free choice the plans and their sensors on, by sets `[G, 1]`; `plans` `[K]` are the rows'."""
    some = (np.flatnonzero(on) for on in sets)
    return [
        (plans[each.rows[on]], each.sensors[on]) for each, on in zip(choices, some, strict=True)
    ]


class Plans:
    """The plans of K rows, the worth of a detection given.

    Args:
        turns: the free choices.
        mass: `[E_0]`, weight of each entry at the start.
        detected: `[E]` for each turn, worth of locating the target there, r + V.
        missed: `[E]`, worth of the target's being missed at the last turn.
        unit: r, by which rounding is measured where a plan is worth less.
        credit: `[E]` for each turn, optimistic gain of locating the target there over missing it; None: none is known.

    Attributes:
        count: K.
        length: H, free choices.
        turns: as given.
        mass, missed: `[E, 1]` as given.
        unit: as given.
        detected: `[E, 1]` for each turn.
    """

    def __init__(
        self,
        turns: Sequence[Turn],
        mass: Array,
        detected: Sequence[Array],
        missed: Array,
        unit: float,
        credit: Sequence[Array] | None = None,
    ) -> None:
        self.turns, self.length, self.count = turns, len(turns), turns[0].choice.count
        self.unit = unit
        self.mass, self.missed, self._credit = mass[:, None], missed[:, None], credit
        self.detected = [each[:, None] for each in detected]

    def undetected(self, t: int, on: AnyArray, later: Array) -> Array:
        """W `[E_before, C]` before step t of set `on` `[G, C]`, followed by `later` `[E, C]` where it misses."""
        # W_t(i) = sum_j P_ij [h_j (r + V(j)) + (1 - h_j) W_{t+1}(j)] - c(A_t) P_in(i), h_j the probability of a report.
        turn = self.turns[t - 1]
        # In place: new arrays would take as long as the sums.
        ahead = (self.detected[t - 1] - later) * turn.choice.report(on)
        ahead += later
        paid = (turn.pay @ on)[turn.before]
        paid *= turn.stay[:, None]
        return turn.moves @ ahead - paid

    def after(self, sets: Sequence[AnyArray], since: int = 0) -> list[Array]:
        """W after the steps since + 1 ... H, `[E, C]` each, when `sets` go on; the first of them is not read."""
        later = [self.missed]
        for t in range(self.length, since + 1, -1):
            later.insert(0, self.undetected(t, sets[t - since - 1], later[0]))
        return later

    def worth(self, sets: Sequence[BoolArray]) -> Array:
        """`[K, C]`, expected reward of whole plans."""
        start = self.undetected(1, sets[0], self.after(sets)[0])
        return self.turns[0].starts @ (self.mass * start)

    def worth_of(self, sets: Sequence[BoolArray]) -> Array:
        """`[K]`, the same of one candidate."""
        return self.worth(sets)[:, 0]

    def rounding(self, worth: Array) -> Array:
        """By how much more than `worth` a plan has to be worth to count as better."""
        return 1e-10 * (self.unit + np.abs(worth))

    def missing(self, t: int, on: AnyArray, mass: Array) -> Array:
        """`[E, C]`, the part of `mass` at step t that the set `on` leaves undetected."""
        return mass * (1.0 - self.turns[t - 1].choice.report(on))

    def pushed(self, sets: Sequence[BoolArray], step: int) -> Array:
        """`[E, C]`, undetected mass at `step`, before its set is sensed."""
        mass = self.mass
        for t in range(1, step):
            mass = self.missing(t, sets[t - 1], self.turns[t - 1].back @ mass)
        return self.turns[step - 1].back @ mass

    def priced(self, t: int, mass: Array) -> Array:
        """`[G, C]`, expected price of each decision of step t, `mass` `[E, C]` being undetected before it."""
        return self.turns[t - 1].price[:, None] * self._come(t, mass)

    def _come(self, t: int, mass: Array) -> Array:
        """`[G, C]`, the part of `mass` `[E, C]` at step t that is in the row of each decision."""
        turn = self.turns[t - 1]
        return (turn.sums @ mass)[turn.choice.rows]

    def ascend(
        self,
        sets: Sequence[BoolArray],
        *,
        sweeps: int,
        mass: Array | None = None,
        since: int = 0,
        optimism: float = 0.0,
        exact: bool = False,
    ) -> list[BoolArray]:
        """At most `sweeps` times, the best set at each step after `since` given the others.

        Args:
            sets: `[G, C]` or, where all candidates have the same, `[G, 1]` for each step after `since`.
            sweeps: passes over the steps; ends early where nothing changes.
            mass: `[E, C]` or `[E, 1]`, undetected after step `since`; None: the start's.
            since: the step that is held, with those before it.
            optimism: weight of `credit` against the exact credit r + V - W.
            exact: whether sets of shared sensors are the best ones, not only good ones.
        """
        begin, sets = self.mass if mass is None else mass, list(sets)
        for _ in range(sweeps):
            now, chosen, after = begin, [], self.after(sets, since)
            for t, later in enumerate(after, start=since + 1):
                turn = self.turns[t - 1]
                now = turn.back @ now
                gain = self._gain(t, later, optimism)
                before = sets[t - since - 1]
                on = turn.choice.best(now * gain, self.priced(t, now), before, exact=exact)
                chosen.append(on)
                now = self.missing(t, on, now)
            if all((new == old).all() for new, old in zip(chosen, sets, strict=True)):
                break
            # All steps are replaced at once, each against the sets before it in this sweep and those after it in the
            # last one: each sweep is worth no less than the last.
            sets = chosen
        return sets

    def advantages(self, chances: Sequence[Array], optimism: float) -> list[Array]:
        """`[G, 1]` for each step: what a sensor's being on gains over its being off, given that its plan comes so far.

        Args:
            chances: `[G, 1]` for each step, probabilities with which the sensors are on, independently of each other.
            optimism: see `ascend`.
        """
        now, found = self.mass, []
        for t, later in enumerate(self.after(chances), start=1):
            turn, on = self.turns[t - 1], chances[t - 1]
            now = turn.back @ now
            gain = turn.choice.slope(now * self._gain(t, later, optimism), on)
            come = self._come(t, now)
            net = gain - turn.price[:, None] * come
            found.append(np.divide(net, come, out=np.zeros_like(net), where=come > 0))
            now = self.missing(t, on, now)
        return found

    def _gain(self, t: int, later: Array, optimism: float) -> Array:
        """`[E, C]`, of locating the target at step t over missing it, which is worth `later`."""
        gain = self.detected[t - 1] - later
        if not optimism:
            return gain
        assert self._credit is not None
        return optimism * self._credit[t - 1][:, None] + (1.0 - optimism) * gain

    def none(self) -> list[BoolArray]:
        """Sets to start from: no sensor is on."""
        return [np.zeros((len(turn.price), 1), bool) for turn in self.turns]
