"""Following several targets step by step: the sensors to switch on, and the reports that come back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self

import numpy as np

from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.memory.keys import KeySpace
from trackmdp.policies.following import Following, probabilities
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.several.merging import Rule, followed


class GroupTracker(Following):
    """A tracker of K targets that are located at the start.

    Args:
        policy: for several targets: `GroupSolution.policy` or `Run.rule`.
        cells: of the targets, by their numbers.
        at: their positions in place of cells, as of `Tracker`.
        modes: of the targets there, where a detection reveals them.

    Raises:
        UserError: no such policy; other cells or positions than one of the grid for each target; or modes are missing,
            or given where detections do not reveal them.

    Example:
        >>> from trackmdp.solvers.solve import solve
        >>> from trackmdp.world.make import make_world
        >>> tracker = GroupTracker(solve(make_world("drift", size=3, targets=2)).policy, [0, 3])
        >>> tracker.sensors()
        [1, 4]
        >>> tracker.report([1, None])
        >>> tracker
        GroupTracker(cells=[1, 3], misses=[0, 1], safe=False)
    """

    def __init__(
        self,
        policy: Rule,
        cells: Sequence[int] | None = None,
        *,
        at: Sequence[tuple[float, float]] | None = None,
        modes: Sequence[int] | None = None,
    ) -> None:
        if not isinstance(policy, Rule):
            raise UserError(
                f"tracker: a {type(policy).__name__}, expected a policy of several targets"
            )
        self._policy, self._group, self._task = policy, policy.group, policy.task
        self._first = self._group.kind * self._group.states  # `[K]`, the first states
        found = [self._cell("tracker", cell) for cell in self._given("tracker", cells, at)]
        state = self._state("tracker", found, modes)
        self._clocks = policy.start(state)
        self._beliefs = Beliefs.of(self._group, self._clocks.present, state)

    def __repr__(self) -> str:
        return f"GroupTracker(cells={self.cells}, misses={self.misses}, safe={self.safe})"

    @property
    def cells(self) -> list[int | None]:
        """The cell of each target's last detection; None where it has left."""
        cells = self._clocks.located[0].tolist()
        return [cell if here else None for cell, here in zip(cells, self.present, strict=True)]

    @property
    def misses(self) -> list[int]:
        """Misses since each target's last detection; of no meaning where it has left."""
        return [int(n) for n in self._clocks.misses[0]]

    @property
    def present(self) -> list[bool]:
        """Which targets are in the grid."""
        return [bool(each) for each in self._clocks.present[0]]

    @property
    def safe(self) -> bool:
        """Whether the safe action is due, which locates all targets."""
        return bool(self._clocks.late(self._policy.task.t_max)[0])

    @property
    def _keys(self) -> KeySpace:
        return self._policy.keys

    def _facts(self) -> dict[str, Any]:
        return super()._facts() | {"targets": list(self._group.targets)}

    def _given(self, call: str, cells: Any, at: Any) -> list[int | None]:
        """A cell for each target, which may be given by positions."""
        none, count = [None] * len(self._group), len(self._group)
        parts = [_each(none if part is None else part, call, count) for part in (cells, at)]
        return [self._one(call, *pair) for pair in zip(*parts, strict=True)]

    def _cell(self, call: str, cell: Any) -> int:
        return whole_number(f"{call}: cell", cell, 0, self._task.num_cells - 1)

    def _state(self, call: str, cells: Sequence[int | None], modes: Any) -> IndexArray:
        """`[1, K]` states of targets located in `cells`, the first of a cell's where its modes are hidden."""
        count, found = self._group.modes // self._group.hidden, list[int]()
        given = [None] * len(cells) if modes is None else _each(modes, f"{call}: modes", len(cells))
        for cell, mode in zip(cells, given, strict=True):
            shown = count > 1 and cell is not None
            if (mode is not None) != shown:
                wanted = f"one of 0 ... {count - 1}" if shown else "none"
                raise UserError(f"{call}: mode={mode}, expected {wanted}")
            found.append(whole_number(f"{call}: mode", mode, 0, count - 1) if shown else 0)
        places = [0 if cell is None else cell for cell in cells]
        return self._group.state_of(np.array([places]), np.array([found]))

    def _chosen(self) -> list[int]:
        """See `Following`; none once all targets have left."""
        if not self._clocks.present.any():
            return []
        return self._policy.sets(self._clocks, self._beliefs.moved(self._group)).tolist()

    def _possible(self, sensors: IndexArray) -> BoolArray:
        """See `Following`."""
        return self._task.available[sensors]

    def belief(self) -> Array:
        """`[K, M]` probability of each cell now, after the last report; 0 where the target has left."""
        return self._masses().reshape(len(self._group), self._task.num_cells, -1).sum(axis=2)

    def _masses(self) -> Array:
        """`[K, Z]`, of each state."""
        found = np.zeros((len(self._group), self._group.states))
        row, state = self._beliefs.row, self._beliefs.state
        found[row, state - self._first[row]] = self._beliefs.mass
        return found

    def report(
        self,
        cells: Sequence[int | None] | None = None,
        gone: Iterable[int] = (),
        *,
        at: Sequence[tuple[float, float] | None] | None = None,
        modes: Sequence[int | None] | None = None,
    ) -> None:
        """Go on by one step.

        Args:
            cells: for each target the cell in which it was detected, or None.
            gone: numbers of targets that have left the grid in this step.
            at: positions in place of cells.
            modes: for each target the mode in which it was detected, where a detection reveals it.

        Raises:
            UserError: no `sensors()` before; a cell is none of the grid or seen by no sensor that is on, a target that
                has left is detected, or one is missed that cannot be; `gone` has no numbers of targets; or modes are
                missing, or given where detections do not reveal them.
        """
        self._check_asked()
        before, count = self._clocks, len(self._group)
        left = [
            whole_number("report: gone", each, 0, count - 1) for each in _each(gone, "report: gone")
        ]
        present = before.present[0] & ~np.isin(np.arange(count), left)
        cells = self._given("report", cells, at)
        seen = np.array([cell is not None for cell in cells])
        if (seen & ~present).any():
            raise UserError(f"report({cells}): expected None for a target that has left")
        for cell in cells:
            if cell is not None:
                self._check_seen("report", self._cell("report", cell))
        state = self._state("report", cells, modes)
        on, moved = np.array(self._on, np.int64), self._beliefs.moved(self._group)
        reports = present[None], seen[None]
        clocks, beliefs = followed(self._policy, before, moved, on, state, reports)
        lost = np.setdiff1d(np.flatnonzero(present & ~seen), beliefs.row)
        if len(lost) and self._group.recorded is None:  # a track may make moves that no other made
            raise UserError(f"report: target {lost[0]} is missed where it would have been detected")
        self._clocks, self._beliefs, self._on = clocks, beliefs, None

    def state(self) -> dict[str, Any]:
        """All that is needed to go on later, as JSON takes it; see `restore`."""
        past = self._clocks.history
        return {
            "task": self._facts(),
            "cells": self._clocks.located[0].tolist(),
            "misses": self.misses,
            "present": self.present,
            "history": None if past is None else np.flatnonzero(past).tolist(),
            "key": None if self._clocks.key is None else self._clocks.key[0].tolist(),
            "on": self._on,
            "belief": [each.tolist() if each.any() else None for each in self._masses()],
        }

    @classmethod
    def restore(cls, policy: Rule, state: Mapping[str, Any]) -> Self:
        """The tracker of a `state()`, with the same policy or another one of the same grid and targets.

        Raises:
            UserError: the state is of another grid, other sensors or other targets, or is no state.
        """
        group = policy.group
        modes = None if group.hidden == group.modes else [0] * len(group)
        tracker = cls(policy, [0] * len(group), modes=modes)
        tracker._check_state(state)
        task, count, past = policy.task, len(group), tracker._clocks.history
        cells, misses, present, beliefs = (
            _each(state[name], f"state: {name}", count)
            for name in ("cells", "misses", "present", "belief")
        )
        if not all(isinstance(here, bool) for here in present):
            raise UserError("state: expected True or False as present")
        located = np.array([[tracker._cell("state", cell) for cell in cells]])
        missed = [whole_number("state: misses", n, 0, task.num_choices) for n in misses]
        if past is not None:
            steps = _each(state["history"], "state: history")
            on = [whole_number("state: history", each, 0, past.size - 1) for each in steps]
            past.reshape(-1)[np.array(on, np.int64)] = True
        key = tracker._clocks.key
        if key is not None:
            given = _each(state["key"], "state: key", count)
            last = policy.keys.num_keys - 1
            key = np.array([[whole_number("state: key", each, 0, last) for each in given]])
            if (policy.keys.cell(key[0]) != cells).any():
                raise UserError(f"state: key={given}: expected keys of the cells {cells}")
        mass = np.zeros((count, group.states))
        for number, (here, given) in enumerate(zip(present, beliefs, strict=True)):
            if here and given is not None:
                mass[number] = probabilities(given, group.states)
        row, place = np.nonzero(mass)
        tracker._beliefs = Beliefs(row, place + tracker._first[row], mass[row, place])
        shown = np.array([missed]), np.array([present])
        tracker._clocks = Clocks(located, *shown, past, key)
        tracker._on = tracker._restored(state["on"])
        return tracker


class Followed:
    """Holds a policy for several targets, its `rule`, by which they can be followed."""

    @property
    def rule(self) -> Rule:
        """The policy."""
        raise NotImplementedError

    def tracker(
        self,
        cells: Sequence[int] | None = None,
        *,
        at: Sequence[tuple[float, float]] | None = None,
        modes: Sequence[int] | None = None,
    ) -> GroupTracker:
        """A tracker that follows the targets, located in `cells` or `at` positions, with `rule`; see `GroupTracker`."""
        return GroupTracker(self.rule, cells, at=at, modes=modes)


def _each(given: Any, call: str, count: int | None = None) -> list[Any]:
    """The items of a sequence.

    Raises:
        UserError: it is no sequence, or has not `count` items.
    """
    found = list(given) if isinstance(given, Iterable) and not isinstance(given, str) else None
    if found is None or (count is not None and len(found) != count):
        wanted = "a sequence" if count is None else f"{count}, one for each target"
        raise UserError(f"{call}({given!r}): expected {wanted}")
    return found
