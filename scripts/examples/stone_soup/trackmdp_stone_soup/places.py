"""Cells and steps of a grid as places and times of Stone Soup; episodes and recorded tracks as ground-truth paths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.state import State

from trackmdp.episodes.episode import Episode
from trackmdp.errors import UserError
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.task import Task


@dataclass(frozen=True)
class Places:
    """The place of each cell and the time of each step.

    A cell is a square of `side` x `side`. Cell 0 has its corner at (0, 0); x grows along the columns, y along the rows.

    Attributes:
        rows: of the grid.
        columns: of the grid.
        side: of a cell, in the unit of the states' coordinates.
        start: time of step 0, at which an episode's target is located in its first cell.
        step: time between two steps.
        mapping: the indices of x and y in a state vector.
    """

    rows: int
    columns: int
    side: float = 1.0
    start: datetime = datetime(2000, 1, 1)
    step: timedelta = timedelta(seconds=1)
    mapping: tuple[int, int] = (0, 1)

    @classmethod
    def of(cls, task: Task, **more: Any) -> Places:
        """The places of a task's grid; `more` are further attributes."""
        return cls(*task.size, **more)

    @property
    def num_cells(self) -> int:
        """M."""
        return self.rows * self.columns

    def centre(self, cell: int) -> npt.NDArray[np.float64]:
        """`[2]` x and y of a cell's middle."""
        row, column = divmod(int(cell), self.columns)
        return (np.array([column, row]) + 0.5) * self.side

    def cell(self, state: State) -> int:
        """The cell of a state; M outside the grid."""
        column, row = (
            int(np.floor(float(state.state_vector[place]) / self.side)) for place in self.mapping
        )
        inside = 0 <= row < self.rows and 0 <= column < self.columns
        return row * self.columns + column if inside else self.num_cells

    def time(self, step: int) -> datetime:
        """The time of a step."""
        return self.start + step * self.step


def paths_of(motions: Iterable[Episode] | Tracks, places: Places) -> list[GroundTruthPath]:
    """The true path of each episode or recorded track, a state in the middle of its cell at each step.

    `metadata["exits"]` of the last state is true where the target left the grid one step later.
    """
    paths = []
    for number, (cells, exits) in enumerate(_cells_of(motions, places.num_cells)):
        states = [
            GroundTruthState(
                places.centre(cell), timestamp=places.time(t), metadata={"cell": int(cell)}
            )
            for t, cell in enumerate(cells)
        ]
        states[-1].metadata["exits"] = exits
        paths.append(GroundTruthPath(states, id=str(number)))
    return paths


def _cells_of(
    motions: Iterable[Episode] | Tracks, num_cells: int
) -> Iterator[tuple[npt.NDArray[np.int64], bool]]:
    """The cells of each motion, and whether it ended with an exit."""
    if isinstance(motions, Tracks):
        cells = np.split(motions.cells, motions.first[1:-1])
        yield from zip(cells, map(bool, motions.exits), strict=True)
        return
    for episode in motions:
        cells = np.concatenate([[episode.start], episode.target])
        yield cells[cells < num_cells], episode.terminated  # the exit, cell M, has no place


def tracks_of(paths: Sequence[GroundTruthPath], places: Places) -> Tracks:
    """The recorded tracks of some paths, one cell for each state.

    A path is cut where it first leaves the grid. It ends with an exit if it left, or if `metadata["exits"]` of its
    last state is true.

    Raises:
        UserError: a path begins outside the grid.
    """
    cells, exits = [], []
    for number, path in enumerate(paths):
        found = np.array([places.cell(state) for state in path])
        outside = np.flatnonzero(found == places.num_cells)
        if not len(found) or found[0] == places.num_cells:
            raise UserError(f"paths[{number}]: expected a path that begins in the grid")
        cells.append(found[: outside[0]] if len(outside) else found)
        exits.append(bool(len(outside)) or ends_with_exit(path))
    first = np.cumsum([0, *map(len, cells)])
    return Tracks(np.concatenate(cells), first, np.array(exits), np.arange(len(paths)))


def ends_with_exit(path: GroundTruthPath) -> bool:
    """Whether the target left the grid after the last state of `path`."""
    return bool(getattr(path[-1], "metadata", {}).get("exits", False))
