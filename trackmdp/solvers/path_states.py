"""Recorded paths as states of policies that remember: what they earn on them, and what a detection is worth there.

On a recorded path every policy can be replayed. At each point where it may locate the target, with each key that it may
then have (`Events`), the path tells what a sensor gains n misses later: r + V - W, V what the policy earns from a
detection there on, W what it earns where it misses, both on this very path. There is no motion model, so nothing needs
to be Markov in the key.

Recorded paths lead to few of the keys there are. What a plan earns on them is found from the sets of their keys alone,
and the table of all keys is made of the plan that was chosen: one of 13 million keys takes a minute and 5 GB.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.recorded import Events
from trackmdp.solvers.renewal import IndexArray
from trackmdp.world.model import Array, BoolArray, Task
from trackmdp.world.tracks import Tracks

_IN_VIEW = 0.999
"""Share of the displacements until the last free choice that are looked after; rare leaps are not."""

SensorsOn: TypeAlias = tuple[IndexArray, IndexArray]
"""Sensors that are on: places in an array of keys, and cells, `[Q]` each."""


@dataclass(frozen=True)
class AlongPaths:
    """A policy followed along all paths.

    Attributes:
        reward: earned, all paths together, undiscounted.
        visited: `[S]` whether the policy gets to the state.
        gain: `[T+1, S]`, what sensing the target at n misses is worth.
        value: `[S]` V.
    """

    reward: float
    visited: BoolArray
    gain: Array
    value: Array


class Paths:
    """All states (point, key) of the paths, and where the target is 1 ... t_max + 2 steps later.

    S states, T + 2 steps (`[T+2, S]` arrays), K displacements in view.

    Attributes:
        times: `[S]`, how often the state's path is among the tracks: those that are equal are worked on as one.
        copies: tracks for each that differs.
    """

    def __init__(self, task: Task, tracks: Tracks) -> None:
        self.task = task
        tracks, times = _different(tracks)
        events = Events.of(tracks, task.keys)
        at = np.flatnonzero(events.possible)
        self.states, self.key = len(at), events.key[at]
        number = np.zeros(len(events.point), dtype=np.int64)  # of a possible state among them
        number[at] = np.arange(self.states)
        point, cells, steps = events.point[at], events.line.cells, range(task.num_choices + 1)
        place = [np.minimum(point + n + 1, events.last[at]) for n in steps]
        self.cells = np.stack([cells[each] for each in place])
        # After a recording has stopped nothing is known, and after the exit nothing happens.
        known = np.stack([point + n + 1 <= events.last[at] for n in steps])
        self.inside: BoolArray = known & (self.cells < task.num_cells)
        follow = [np.where(self.inside[n], events.follow(at, n), 0) for n in steps]
        self.following = np.stack([number[each] for each in follow])
        self.first = number[events.first]
        self.times = np.repeat(times, np.diff(events.line.first))[point].astype(np.float64)
        self.copies = float(times.mean())
        self.seen, self.of_seen = np.unique(self.key, return_inverse=True)
        self._measure()

    def _measure(self) -> None:
        """Displacements from the located cell, as numbers in a square window; K, none, beyond it."""
        task, columns = self.task, self.task.columns
        start = task.keys.cell(self.key)
        rows, across = self.cells // columns - start // columns, self.cells % columns - start % columns
        far = np.maximum(np.abs(rows), np.abs(across))[:-1]
        seen = far[self.inside[:-1]]
        radius = int(np.ceil(np.quantile(seen, _IN_VIEW))) if len(seen) else 0
        self.radius = min(max(1, radius), self.task.rows + self.task.columns, task.window or 2**31)
        side = 2 * self.radius + 1
        self.width = side**2
        number = (rows[:-1] + self.radius) * side + across[:-1] + self.radius
        self.local = np.where(self.inside[:-1] & (far <= self.radius), number, self.width)

    @cached_property
    def price(self) -> Array:
        """`[T+1, S]` price of the sensor where the target is; infinite where it is out of view."""
        return np.where(self.local < self.width, np.append(self.task.cost, np.inf)[self.cells[:-1]], np.inf)

    def put_down(self, start: IndexArray, local: IndexArray) -> tuple[IndexArray, BoolArray]:
        """Cells of displacements `local` from cells `start`, and whether they are in the grid."""
        side = 2 * self.radius + 1
        row = start // self.task.columns + local // side - self.radius
        column = start % self.task.columns + local % side - self.radius
        inside = (row >= 0) & (row < self.task.rows) & (column >= 0) & (column < self.task.columns)
        return row * self.task.columns + column, inside

    def sensed(self, n: int, sets: sparse.csr_array) -> tuple[BoolArray, Array]:
        """`[S]` whether `sets` `[keys seen, M]` sense the target after n misses, and `[S]` what they cost."""
        hits, there = np.zeros(self.states, dtype=bool), np.flatnonzero(self.inside[n])
        hits[there] = np.asarray(sets[self.of_seen[there], self.cells[n, there]]).ravel()
        spent: Array = (sets.astype(np.float64) @ self.task.cost)[self.of_seen]
        return hits, spent

    def followed(self, sets: Sequence[sparse.csr_array], discount: float) -> AlongPaths:
        """What the `sets` `[keys seen, M]` of each n earn on every path."""
        hits, spent = zip(*(self.sensed(n, each) for n, each in enumerate(sets)), strict=True)
        return self.follow(np.stack(hits), np.stack(spent), discount)

    def follow(self, hits: BoolArray, spent: Array, discount: float) -> AlongPaths:
        """What a policy earns on every path, given where its plans hit `[T+1, S]` and what they cost `[T+1, S]`."""
        task, last = self.task, self.task.num_choices
        # Backwards through a plan: what it earns until its detection, and which state that leads to (the state itself
        # with factor 0 where there is none), once from each n on.
        earned, factor = np.zeros((last + 1, self.states)), np.zeros((last + 1, self.states))
        onward = np.tile(np.arange(self.states), (last + 1, 1))
        plain = np.zeros(self.states)
        for n in range(last, -1, -1):
            stay = self.inside[n]
            found = stay & hits[n] if n < last else stay
            price = spent[n] if n < last else task.safe_cost
            follows = n < last
            later, factors, states = (
                (earned[n + 1], factor[n + 1], onward[n + 1]) if follows else (0.0, 0.0, onward[last])
            )
            earned[n] = stay * (np.where(found, task.reward, discount * later) - price)
            plain = stay * (np.where(found, task.reward, plain) - price)
            factor[n] = stay * np.where(found, discount, discount * factors)
            onward[n] = np.where(found, self.following[n], states)
        value = _totals(earned[0], factor[0], onward[0])
        visited = self._visited(onward[0], factor[0] > 0)
        missed = earned + factor * value[onward]  # [T+2, S], W_n
        gain = task.reward + discount * (value[self.following[:-1]] - missed[1:])
        return AlongPaths(float(plain[visited] @ self.times[visited]), visited, gain, value)

    def _visited(self, onward: IndexArray, goes_on: BoolArray) -> BoolArray:
        visited = np.zeros(self.states, dtype=bool)
        at: IndexArray = self.first
        while len(at):  # one step a detection, all paths at once
            visited[at] = True
            at = onward[at[goes_on[at]]]
        return visited


def _different(tracks: Tracks) -> tuple[Tracks, IndexArray]:
    """The tracks that differ in where they lead, `[K]` of them, and how often each is there."""
    number: dict[tuple[bytes, bool], int] = {}
    pieces = zip(np.split(tracks.cells, tracks.first[1:-1]), tracks.exits.tolist(), strict=True)
    each = [number.setdefault((cells.tobytes(), leaves), len(number)) for cells, leaves in pieces]
    _, first, times = np.unique(each, return_index=True, return_counts=True)
    chosen = np.zeros(len(tracks), dtype=bool)
    chosen[first] = True
    return tracks.select(chosen), times


def _totals(earned: Array, factor: Array, onward: IndexArray) -> Array:
    """`[S]` v = earned + factor · v[onward], along chains that end in factor 0: doubled until none goes on."""
    # After k rounds `earned` is that of 2^k detections, and `factor` what is left of what follows them.
    while factor.any():
        earned, factor, onward = earned + factor * earned[onward], factor * factor[onward], onward[onward]
    return earned


@dataclass(frozen=True)
class KeyPlans:
    """A policy that does not draw.

    Attributes:
        task: limits and memory.
        keys: `[K]` those whose sets are there, in order.
        sets: `[K, M]` bool, one for each n.
        others: what is on after n misses and any other keys.
    """

    task: Task
    keys: IndexArray
    sets: list[sparse.csr_array]
    others: Callable[[int, IndexArray], SensorsOn]

    @classmethod
    def of_table(cls, policy: PolicyTable, keys: IndexArray) -> KeyPlans:
        """A policy with sets, `keys` apart."""
        table, choices = policy.sets, policy.task.num_choices
        assert table is not None

        def rows(n: int, keys: IndexArray) -> sparse.csr_array:
            return sparse.csr_array(table[keys * choices + n])

        def others(n: int, keys: IndexArray) -> SensorsOn:
            return _entries(rows(n, keys))

        return cls(policy.task, keys, [rows(n, keys) for n in range(choices)], others)

    def of(self, keys: IndexArray) -> list[sparse.csr_array]:
        """`[len(keys), M]` bool, the sets of `keys`, for each n."""
        shape = (len(keys), self.task.num_cells)
        return [sensed_table(*each, shape) for each in self._sensed(keys)]

    def table(self) -> PolicyTable:
        """The sets of all keys there are."""
        return PolicyTable.from_sensed(self.task, self._sensed(np.arange(self.task.num_keys)))

    def _sensed(self, keys: IndexArray) -> list[SensorsOn]:
        place = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        known = self.keys[place] == keys
        mine, rest = np.flatnonzero(known), np.flatnonzero(~known)
        found = []
        for n, sets in enumerate(self.sets):
            (own, cells), (other, more) = _entries(sets[place[mine]]), self.others(n, keys[rest])
            found.append((np.concatenate([mine[own], rest[other]]), np.concatenate([cells, more])))
        return found


def sensed_table(rows: IndexArray, cells: IndexArray, shape: tuple[int, int]) -> sparse.csr_array:
    """`[K, M]` bool, with these entries."""
    return sparse.csr_array((np.ones(len(rows), dtype=bool), (rows, cells)), shape=shape)


def _entries(sets: sparse.csr_array) -> SensorsOn:
    listed = sets.tocoo()
    return listed.row.astype(np.int64), listed.col.astype(np.int64)
