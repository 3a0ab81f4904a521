"""Following several targets step by step: the sensors to switch on, and the reports that come back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from trackmdp.arrays.numbers import whole_number
from trackmdp.errors import UserError
from trackmdp.solvers.several.merging import Beliefs, Rule, followed


class GroupTracker:
    """A tracker of K targets that are located at the start.

    Args:
        policy: for several targets, such as `GroupSolution.policy`.
        cells: of the targets, by their numbers.

    Raises:
        UserError: other cells than one of the grid for each target.

    Example:
        >>> from trackmdp.solvers.solve import solve
        >>> from trackmdp.world.make import make_world
        >>> tracker = GroupTracker(solve(make_world("drift", size=3, targets=2)).policy, [0, 3])
        >>> tracker.sensors()
        [1, 4]
        >>> tracker.report([1, None])
        >>> tracker.misses
        [0, 1]
    """

    def __init__(self, policy: Rule, cells: Sequence[int]) -> None:
        self._policy, self._group = policy, policy.group
        count, self._cells = len(self._group), policy.task.num_cells
        found = [
            whole_number("tracker: cell", cell, 0, self._cells - 1)
            for cell in _each(cells, "tracker", count)
        ]
        located = np.array(found) + self._group.kind * self._cells
        self._clocks = policy.start(located[None])
        self._beliefs = Beliefs.at(np.arange(count), located)

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

    def sensors(self) -> list[int]:
        """The sensors to switch on in this step: all where the safe action is due, none once all targets have left."""
        if not self._clocks.present.any():
            return []
        if self.safe:
            return [int(j) for j in np.flatnonzero(self._policy.task.available)]
        moved = self._beliefs.moved(self._group)
        return [int(j) for j in self._policy.sets(self._clocks, moved)]

    def report(self, cells: Sequence[int | None], gone: Iterable[int] = ()) -> None:
        """Go on by one step.

        Args:
            cells: for each target the cell in which it was detected, or None.
            gone: numbers of targets that have left the grid in this step.

        Raises:
            UserError: a cell is none of the grid or seen by no sensor that is on, a target that has left is detected,
                or one is missed that cannot be; or `gone` has no numbers of targets.
        """
        before, count = self._clocks, len(self._group)
        left = [
            whole_number("report: gone", each, 0, count - 1) for each in _each(gone, "report: gone")
        ]
        present = before.present[0] & ~np.isin(np.arange(count), left)
        cells = _each(cells, "report", count)
        seen = np.array([cell is not None for cell in cells])
        if (seen & ~present).any():
            raise UserError(f"report({cells}): expected None for a target that has left")
        place = np.array(
            [
                0 if cell is None else whole_number("report: cell", cell, 0, self._cells - 1)
                for cell in cells
            ]
        )
        on, moved = np.array(self.sensors(), dtype=np.int64), self._beliefs.moved(self._group)
        if not self.safe and (seen & ~np.isin(place, on)).any():
            raise UserError(
                f"report({cells}): a cell is seen by none of the {len(on)} sensors that are on, expected "
                "one that is, or None"
            )
        states, reports = place + self._group.kind * self._cells, (present[None], seen[None])
        clocks, beliefs = followed(self._group, before, moved, on, states[None], reports)
        lost = np.setdiff1d(np.flatnonzero(present & ~seen), beliefs.row)
        if len(lost) and self._group.recorded is None:  # a track may make moves that no other made
            raise UserError(f"report: target {lost[0]} is missed where it would have been detected")
        self._clocks, self._beliefs = clocks, beliefs


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
