"""Renewals: all that may happen from one detection to the next, for every world alike (theory.md#exact-value).

After an event the target moves once before each of t_max + 1 free choices, and once more before the safe action. A
*step* lists the places where it may then be: entries (event, state).

On a line of four cells, where the target moves one cell to the right or stays in cell 3, events are cells, and

    events 0 1 2 3        step 0: (0,1) (1,2) (2,3) (3,3)        step 1: (0,2) (1,3) (2,3) (3,3)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import among, distinct, ends_of, index_type, per_row
from trackmdp.arrays.types import Array, BoolArray, IndexArray, Indices
from trackmdp.memory.keys import KeySpace
from trackmdp.motion.chain import Motion
from trackmdp.sensing.task import Task
from trackmdp.solvers.events import Events, detected_codes, forced_codes, started

_FEW = 2**14
"""States whose moves are gathered here: before SciPy looks at a single one, it takes a tenth of a millisecond."""
_NONE = sparse.csr_array((0, 0))


@dataclass(frozen=True, eq=False)
class Step:
    """The entries after a move, in order of (event, state).

    Attributes:
        n: misses before.
        rows: `[E]`, event of each entry.
        states: `[E]`, the target's state.
        moves: `[E_before, E]`, probability of each move, from the entries of the step before, or from the events;
            empty where the walk is not closed.
        following: `[E]`, the event that a detection leads to (or its code, see `Events`).
        missed: `[E]`, the same for a miss of the safe action; None at free choices, and where it never misses.
        before: `[E_before]`, event of each entry before the move.
        stay: `[E_before]`, probability of still being in the grid after the move.
        goes_on: `[E_before]`, whether there is a next step at all; None: everywhere (a recording may stop).
        begun: events that begin here, the last entries before the move.
        count: B, of the events that begin.
        width: of all events.
    """

    n: int
    rows: IndexArray
    states: IndexArray
    moves: sparse.csr_array
    following: IndexArray
    missed: IndexArray | None
    before: IndexArray
    stay: Array
    goes_on: BoolArray | None
    begun: int
    count: int
    width: int

    @cached_property
    def back(self) -> sparse.csc_array:
        """`[E, E_before]`, the moves the other way round."""
        return self.moves.T

    @cached_property
    def pointer(self) -> IndexArray:
        """`[B + 1]`, where the entries of each event begin, and where the last ones end."""
        ends = ends_of(np.bincount(self.rows, minlength=self.count))
        return ends.astype(index_type(len(self.rows)))

    def summed(self, values: Array) -> Array:
        """`[B]` sums of `values` `[E]` over the entries of each event."""
        return per_row(self.rows, values, self.count)


class Walk:
    """The steps of all events, one by one; entries that are surely detected need not go on.

    Args:
        task: its t_max and its safe action.
        motion: of the target.
        events: where renewals begin.
        closed: whether steps lead to the numbers of events; else to their codes.
        every: all events, where `events` are a part of them.
    """

    def __init__(
        self,
        task: Task,
        motion: Motion,
        events: Events,
        *,
        closed: bool = True,
        every: Events | None = None,
    ) -> None:
        self._task, self._motion, self._events, self._closed = task, motion, events, closed
        self._every = events if every is None else every
        count = len(events.codes) - events.forced
        self._rows: IndexArray = np.arange(count, dtype=index_type(len(events.codes)))
        self._states = events.state[:count]
        self._live: IndexArray | None = None
        self._n = 0

    def keep(self, live: BoolArray) -> None:
        """Of the entries of the last step only these `[E]` move on."""
        self._live = None if live.all() else np.flatnonzero(live)

    def move(self) -> Step:
        """The next step: of a free choice, or after t_max + 1 of them of the safe action."""
        events, motion, last = self._events, self._motion, self._n == self._task.num_choices
        begun = events.forced if last else 0
        if begun:
            self._begin(begun)
        rows, states = self._rows, self._states
        from_rows, from_states = rows, states
        if self._live is not None:
            from_rows, from_states = rows[self._live], states[self._live]
        data, to, counts = self._out(from_states)
        source, target = np.repeat(from_rows, counts), None
        if len(from_rows) > 1 and not (from_rows[1:] > from_rows[:-1]).all():
            # Event 2 in state 5 of 16 states has the number 2 * 16 + 5 = 37; sorted numbers are the new entries.
            codes = source.astype(np.int64) * motion.num_states + to
            codes, target = np.unique(codes, return_inverse=True)
            source, to = np.divmod(codes, motion.num_states)
            source = source.astype(rows.dtype)
            to = to.astype(motion.moves.indices.dtype)
        moves = _NONE
        if self._closed:
            moves = _moves(data, target, counts, self._live, (len(rows), len(source)))
        step = self._step(source, to, moves, begun, last=last)
        self._rows, self._states, self._live = source, to, None
        self._n += 1
        return step

    def _out(self, states: IndexArray) -> tuple[Array, IndexArray, IndexArray]:
        """Probability and new state `[E]` of each move out of `states`, and how many each of them has."""
        moves = self._motion.moves
        if len(states) >= _FEW:
            if len(states) != self._motion.num_states or (np.diff(states) != 1).any():
                moves = moves[states]
            return moves.data, moves.indices, np.diff(moves.indptr)
        begin = moves.indptr[states]
        counts = moves.indptr[states + 1] - begin
        # Rows of 2, 0 and 1 entries that begin at 7, 9 and 4: 7 8 4, which is 0 1 2 and 7 7 2.
        places = np.repeat(begin - np.cumsum(counts) + counts, counts)
        places += np.arange(len(places), dtype=places.dtype)
        return moves.data[places], moves.indices[places], counts

    def _begin(self, begun: int) -> None:
        """Add the missed targets of the safe action, which move as the others do."""
        events, entries = self._events, len(self._rows)
        more = np.arange(len(events.codes) - begun, len(events.codes), dtype=self._rows.dtype)
        if self._live is not None:
            self._live = np.concatenate([self._live, entries + np.arange(begun)])
        self._rows = np.concatenate([self._rows, more])
        self._states = np.concatenate([self._states, events.state[more]])

    def _step(
        self,
        rows: IndexArray,
        states: IndexArray,
        moves: sparse.csr_array,
        begun: int,
        *,
        last: bool,
    ) -> Step:
        motion, misses = self._motion, last and not self._task.safe
        following, missed = self._after(rows, states, misses=misses)
        stops = None if motion.ends is None else motion.ends[self._states]
        return Step(
            self._n,
            rows,
            states,
            moves,
            following,
            missed,
            self._rows,
            motion.stay[self._states],
            None if stops is None else ~stops,
            begun,
            len(self._events.codes),
            len(self._every.codes),
        )

    def _after(
        self, rows: IndexArray, states: IndexArray, *, misses: bool
    ) -> tuple[IndexArray, IndexArray | None]:
        """`[E]` events after a detection, and after a missed safe action; None where there is none."""
        events, motion, keys = self._events, self._motion, self._events.keys
        if self._closed and self._every.complete:
            return states, states + motion.num_states if misses else None
        key = events.key[rows]
        after = keys.next(key, self._n, motion.cell[states], states % motion.modes)
        found = [detected_codes(keys, after, states)]
        if misses:
            found.append(forced_codes(keys, motion.num_states, key, states))
        if self._closed:
            found = [np.searchsorted(self._every.codes, codes) for codes in found]
        return found[0], found[1] if misses else None


def _moves(
    data: Array,
    target: IndexArray | None,
    counts: IndexArray,
    live: IndexArray | None,
    shape: tuple[int, int],
) -> sparse.csr_array:
    """`[E_before, E]` of the moves `data` of `live` entries, each to its `target`, or to an entry of its own."""
    every: Indices = counts.astype(np.int64, copy=False)
    if live is not None:
        every = np.zeros(shape[0], np.int64)
        every[live] = counts
    pointer = ends_of(every)
    width = index_type(max(len(data), *shape))
    target = (
        np.arange(shape[1], dtype=width) if target is None else target.astype(width, copy=False)
    )
    return sparse.csr_array((data, target, pointer.astype(width, copy=False)), shape=shape)


def all_events(
    task: Task, keys: KeySpace, motion: Motion, reports: Reports | None = None
) -> Events:
    """The events that can follow an episode's start.

    Args:
        task: its t_max and its safe action.
        keys: of the policies.
        motion: of the target.
        reports: probability of a report under the one policy that is followed; None: all policies.
    """
    states = np.arange(motion.num_states)
    if keys.order == 0:
        parts = [started(keys, motion, states)]
        if not task.safe:
            parts.append(forced_codes(keys, motion.num_states, states, states))
        return Events(keys, motion.num_states, np.concatenate(parts))
    known = frontier = distinct(started(keys, motion, motion.first))
    if motion.ends is not None:
        return _along_tracks(task, motion, Events(keys, motion.num_states, known), reports)
    while len(frontier):
        events = Events(keys, motion.num_states, frontier)
        after = distinct(np.concatenate(list(_following(task, motion, events, reports))))
        frontier = after[~among(known, after)[1]]
        known = np.sort(np.concatenate([known, frontier]))
    return Events(keys, motion.num_states, known)


def _along_tracks(task: Task, motion: Motion, starts: Events, reports: Reports | None) -> Events:
    """See `all_events`: step by step along all tracks at once, since what follows an event is a few steps later."""
    points = np.arange(motion.num_states)
    begins = np.ones(len(points), bool)
    begins[motion.moves.indices] = False
    step = points - np.maximum.accumulate(np.where(begins, points, 0))

    def steps_of(codes: Indices) -> IndexArray:
        return np.asarray(step[codes // starts.keys.num_keys % len(points)])

    order = np.argsort(steps_of(starts.codes), kind="stable")
    begun = np.split(starts.codes[order], np.cumsum(np.bincount(steps_of(starts.codes)))[:-1])
    known, later = [], np.zeros(0, np.int64)
    for now in range(int(step.max()) + 1):
        here = steps_of(later) <= now
        some = np.concatenate([later[here], *begun[now : now + 1]])
        frontier = distinct(some)
        known.append(frontier)
        if len(frontier):
            events = Events(starts.keys, starts.states, frontier)
            found = [later[~here], *_following(task, motion, events, reports)]
            later = distinct(np.concatenate(found))
    return Events(starts.keys, starts.states, np.sort(np.concatenate(known)))


Reports: TypeAlias = Callable[[int, IndexArray, IndexArray], Array]
"""From misses n, keys `[E]` and cells `[E]` to the probability of a report `[E]`."""


def _following(
    task: Task, motion: Motion, events: Events, reports: Reports | None
) -> Iterator[IndexArray]:
    """Codes of the events that follow `events` by one detection, or by one missed safe action."""
    walk = Walk(task, motion, events, closed=False)
    for n in range(task.num_choices + 1):
        step = walk.move()
        if n < task.num_choices and reports is not None:
            report = reports(n, events.key[step.rows], motion.cell[step.states])
            yield step.following[report > 0]
            walk.keep(report < 1)
        else:
            yield step.following
        if step.missed is not None:
            yield step.missed
