"""Knowledge of several targets: the clocks that a tracker is shown, and a belief of each target.

Each target has a belief of its own, under all sets that were really on. Beliefs of many episodes are lists of entries
(row, state): row e · K + i is target i of episode e, and the states of all motions lie one after the other
(`Group.kernel`). Example: two targets that move alike, one episode; target 0 may be in cell 4 or 5, target 1 in 4:

    row  0 0 1        state  4 5 4        mass  .3 .6 .9
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from trackmdp.arrays.entries import among, per_row
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.sensing.decisions import report_chance
from trackmdp.world.group import Group


@dataclass(frozen=True)
class Clocks:
    """What the tracker is shown of E episodes; the other parts of a target that has left count for nothing.

    Attributes:
        located: `[E, K]`, cell of the last detection.
        misses: `[E, K]`, n.
        present: `[E, K]`, whether the target is in the grid.
        history: `[E, t_max + 1, S]`, the sets of the last steps, the latest first, for a rule that `reads_history`.
        key: `[E, K]`, of each target's plan, where that remembers more than the cell.
    """

    located: IndexArray
    misses: IndexArray
    present: BoolArray
    history: BoolArray | None = None
    key: IndexArray | None = None

    def late(self, t_max: int) -> BoolArray:
        """`[E]`, whether the safe action is due."""
        return np.any(self.present & (self.misses > t_max), axis=1)

    def remembered(self, on: IndexArray, late: BoolArray) -> BoolArray | None:
        """The history after a step with the sensors `on`, sorted numbers e · S + j; none after a safe action."""
        if self.history is None:
            return None
        latest = np.zeros_like(self.history[:, :1])
        latest.reshape(-1)[on] = True
        return np.concatenate([latest, self.history[:, :-1]], axis=1) & ~late[:, None, None]


@dataclass(frozen=True)
class Beliefs:
    """Entries of the beliefs of all rows, in order of (row, state).

    Attributes:
        row, state: `[L]`.
        mass: `[L]`, probability of each, given all that the tracker is shown.
    """

    row: IndexArray
    state: IndexArray
    mass: Array

    @classmethod
    def none(cls) -> Beliefs:
        """No entries, for a policy that reads none."""
        nothing = np.zeros(0, np.int64)
        return cls(nothing, nothing, np.zeros(0))

    @classmethod
    def of(cls, group: Group, present: BoolArray, state: IndexArray) -> Beliefs:
        """At the start, where the targets that are `present` `[E, K]` are located in their `state` `[E, K]`."""
        rows = np.flatnonzero(present)
        return cls.found(group, rows, state.ravel()[rows])

    @classmethod
    def found(cls, group: Group, rows: IndexArray, state: IndexArray) -> Beliefs:
        """Targets located in their `state`: in its cell, in any of the modes that are hidden alike."""
        modes = group.hidden
        states = ((state // modes * modes)[:, None] + np.arange(modes)).ravel()
        return cls(np.repeat(rows, modes), states, np.full(len(states), 1.0 / modes))

    @classmethod
    def recalled(cls, group: Group, clocks: Clocks) -> Beliefs:
        """From the sets of the steps since each detection, in which no safe action has missed."""
        assert clocks.history is not None
        misses, beliefs = np.where(clocks.present, clocks.misses, -1).ravel(), cls.none()
        state = group.state_of(clocks.located).ravel()
        for back in range(group.task.t_max, -1, -1):
            rows = np.flatnonzero(misses == back)
            beliefs = beliefs.joined(cls.found(group, rows, state[rows]))
            if back:  # the step that was `back` steps ago, the latest one being 1
                moved, on = beliefs.moved(group), np.flatnonzero(clocks.history[:, back - 1])
                episode, cell = moved.row // len(group), group.cell_of(moved.state)
                chance = report_chance(group.task, on, episode, cell)
                beliefs = moved.given(misses >= back, chance, misses.size)
        return beliefs

    def seen(self, group: Group, rows: IndexArray, state: IndexArray) -> Beliefs:
        """The targets `rows` of a step's `moved` beliefs, located in their `state`.

        What is known of hidden modes is kept, but where no move known leads to the cell.
        """
        anew = Beliefs.found(group, rows, state)
        if group.hidden == 1:
            return anew
        place, known = among(rows, self.row)
        here = np.flatnonzero(known)
        here = here[self.state[here] // group.modes == (state // group.modes)[place[here]]]
        row, mass = self.row[here], self.mass[here]
        total = per_row(row, mass, int(rows.max(initial=-1)) + 1)
        lost = total[anew.row] == 0
        rest = Beliefs(anew.row[lost], anew.state[lost], anew.mass[lost])
        return Beliefs(row, self.state[here], mass / total[row]).joined(rest)

    def moved(self, group: Group) -> Beliefs:
        """After a move; masses of a row then sum to the probability that its target is in the grid."""
        kernel = group.kernel
        begin, count = kernel.indptr[self.state], np.diff(kernel.indptr)[self.state]
        # Entries 4 .. 6 and 9 .. 10 of the kernel, one after the other: 4 5 6 9 10.
        source = np.repeat(np.arange(len(count)), count)
        entry = np.arange(len(source)) + (begin - np.cumsum(count) + count)[source]
        codes = self.row[source] * kernel.shape[0] + kernel.indices[entry]
        found, place = np.unique(codes, return_inverse=True)
        mass = per_row(place, self.mass[source] * kernel.data[entry], len(found))
        row, state = np.divmod(found, kernel.shape[0])
        return Beliefs(row, state, mass)

    def given(self, kept: BoolArray, seen: Array, rows: int) -> Beliefs:
        """The rows `kept` `[rows]` of a step's `moved` beliefs, their targets in the grid and missed.

        Args:
            kept: rows of targets that are in the grid and were not detected.
            seen: `[L]`, probability of a report at each entry.
            rows: E · K.
        """
        mass = self.mass * (1.0 - seen)
        some = kept[self.row] & (mass > 0)
        row, mass = self.row[some], mass[some]
        return Beliefs(row, self.state[some], mass / per_row(row, mass, rows)[row])

    def joined(self, other: Beliefs) -> Beliefs:
        """The entries of both in order; no row is in both."""
        order = np.argsort(np.concatenate([self.row, other.row]), kind="stable")
        pairs: Any = (self.row, other.row), (self.state, other.state), (self.mass, other.mass)
        return Beliefs(*(np.concatenate(pair)[order] for pair in pairs))
