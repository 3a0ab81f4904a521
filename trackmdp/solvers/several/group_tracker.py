"""Following several targets step by step: the sensors to switch on, and the reports that come back."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

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
        if len(cells) != count or not all(0 <= cell < self._cells for cell in cells):
            raise UserError(
                f"cells={list(cells)}: expected {count}, each from 0 to {self._cells - 1}"
            )
        located = np.asarray(cells, dtype=np.int64) + self._group.kind * self._cells
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
            UserError: a cell is none of the grid, a target that has left is detected, or one is missed that cannot be.
        """
        before = self._clocks
        present = before.present[0] & ~np.isin(np.arange(len(before.present[0])), list(gone))
        seen = np.array([cell is not None for cell in cells])
        if len(seen) != len(present) or (seen & ~present).any():
            raise UserError(
                f"report({list(cells)}): expected a cell or None for each target, None once it has left"
            )
        place = np.array([0 if cell is None else cell for cell in cells])
        if not ((place >= 0) & (place < self._cells)).all():
            raise UserError(f"report({list(cells)}): expected cells from 0 to {self._cells - 1}")
        on, moved = np.array(self.sensors(), dtype=np.int64), self._beliefs.moved(self._group)
        states, reports = place + self._group.kind * self._cells, (present[None], seen[None])
        clocks, beliefs = followed(self._group, before, moved, on, states[None], reports)
        lost = np.setdiff1d(np.flatnonzero(present & ~seen), beliefs.row)
        if len(lost) and self._group.recorded is None:  # a track may make moves that no other made
            raise UserError(f"report: target {lost[0]} is missed where it would have been detected")
        self._clocks, self._beliefs = clocks, beliefs
