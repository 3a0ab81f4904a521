"""What the trackers of one target and of several share: the sensors that are on, positions, and what a state holds."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.memory.keys import KeySpace
from trackmdp.sensing.task import Task


class Following(ABC):
    """A tracker at work: each step `sensors()` are switched on, and what they report follows."""

    _task: Task
    _on: list[int] | None = None
    _exited = False

    @property
    @abstractmethod
    def safe(self) -> bool:
        """Whether the safe action is due: all sensors on."""

    @abstractmethod
    def _chosen(self) -> list[int]:
        """The policy's own choice, before any safe action."""

    @abstractmethod
    def _possible(self, sensors: IndexArray) -> BoolArray:
        """Whether each of `sensors` can be on now."""

    def sensors(self) -> list[int]:
        """The ids of the sensors to switch on now, in order; the same until the next report.

        Raises:
            UserError: the target has exited.
        """
        self._check_followed("sensors()")
        if self._on is None:
            everything = np.flatnonzero(self._task.available).tolist()
            self._on = everything if self.safe else self._chosen()
        return list(self._on)

    def positions(self) -> list[tuple[float, float]]:
        """The positions of the cells sensed now, (lat, lon) or (x, y); those of `sensors()`, but for footprints.

        Raises:
            UserError: the target has exited, or the place of the grid is not known.
        """
        self.sensors()
        return [self._task.place_of(cell) for cell in np.flatnonzero(self._seen()).tolist()]

    def sees(self, cell: int) -> bool:
        """Whether a sensor that is on covers a cell; the safe action does everywhere. None is on before `sensors()`.

        Raises:
            UserError: the cell is outside the grid.
        """
        return bool(self._seen()[whole_number("sees: cell", cell, 0, self._task.num_cells - 1)])

    def _seen(self) -> BoolArray:
        """`[M]` whether a sensor that is on covers a cell."""
        if self._on is None or self.safe:
            return np.full(self._task.num_cells, self._on is not None)
        return self._task.covered(self._action())

    def _action(self) -> BoolArray:
        """`[S]` whether each sensor is on."""
        action = np.zeros(self._task.total_sensors, bool)
        action[self._on or []] = True
        return action

    def _check_followed(self, call: str) -> None:
        if self._exited:
            raise UserError(f"{call}: the target has exited, expected a new tracker")

    def _check_asked(self) -> None:
        self._check_followed("report")
        if self._on is None:
            raise UserError("report: no sensors() since the last report, expected sensors() before")

    def _check_seen(self, call: str, cell: int) -> None:
        if not self.sees(cell):
            raise UserError(
                f"{call}: cell {cell} is seen by none of the {len(self._on or ())} sensors that are on, expected "
                "one that is, or None"
            )

    def _one(self, call: str, cell: int | None, at: tuple[float, float] | None) -> int | None:
        """The cell, which may be given by a position."""
        if at is None:
            return cell
        if cell is not None:
            raise UserError(f"{call}: cell={cell} and at={at}, expected one of the two")
        if not isinstance(at, Iterable) or len(pair := tuple(at)) != 2:
            raise UserError(f"{call}: at={at}, expected two numbers")
        return self._task.cell_of(*pair)

    @property
    def _keys(self) -> KeySpace:
        """The keys of the policy."""
        return self._task.keys

    def _facts(self) -> dict[str, Any]:
        """The facts of the task that keys and sensor ids depend on."""
        keys, mark = asdict(self._keys) | {"size": list(self._task.size)}, self._task.footprints
        own = {} if mark is None else {"footprints": mark}
        return keys | {"sensors": self._task.total_sensors} | own

    def _check_state(self, state: Any) -> None:
        """Raise a `UserError` unless a state has the parts of this tracker's, and is of the same facts."""
        expected = self.state()
        if not isinstance(state, Mapping) or set(state) != set(expected):
            raise UserError(f"state: expected a dict with {', '.join(sorted(expected))}")
        if state["task"] != expected["task"]:
            raise UserError(f"state: made for {state['task']}, expected {expected['task']}")

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that is needed to go on later, as JSON takes it; see `restore`."""

    def _restored(self, on: Any) -> list[int] | None:
        """The sensors that are on in a state.

        Raises:
            UserError: they are not all where the safe action is due, or no set that can be chosen where it is not.
        """
        if not isinstance(on, list | None):
            raise UserError("state: expected a list or None as on")
        if on is None:
            return None
        last, everything = self._task.total_sensors - 1, np.flatnonzero(self._task.available)
        found = [whole_number("state: on", each, 0, last) for each in on]
        if self.safe:
            fits, wanted = found == everything.tolist(), "all sensors, the safe action is due"
        else:
            most = self._task.budget
            possible = self._possible(np.array(found, np.int64))
            fits = found == sorted(set(found)) and bool(possible.all())
            fits = fits and (most is None or len(found) <= most)
            limit = "" if most is None else f"at most {most} "
            wanted = f"{limit}sensors that can be on, in order"
        if not fits:
            raise UserError(f"state: on={found}: expected {wanted}")
        return found


def probabilities(given: Any, states: int) -> Array:
    """`[1, states]`, the belief in a state; zeros for a target that by its motion must have left.

    Raises:
        UserError: there are no such probabilities in it.
    """
    numbers = given if isinstance(given, list) else []
    if all(type(each) in (int, float) and 0 <= each <= 1.1 for each in numbers):
        found = np.array([numbers], np.float64)
        if found.shape[1] == states and (not found.any() or abs(found.sum() - 1.0) < 1e-6):
            return found
    raise UserError(f"state: belief, expected {states} probabilities that sum to 1")
