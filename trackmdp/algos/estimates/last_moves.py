"""The last moves of targets on paths, which tell of the next one where targets keep a heading."""

from __future__ import annotations

import numpy as np

from trackmdp.arrays.types import IndexArray
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.task import Task


def displacements(task: Task, before: IndexArray, after: IndexArray) -> IndexArray:
    """`[H]`, the moves seen, each as one number (`shift`), in increasing order; 0 for a stop is always one."""
    inside = after < task.num_cells
    return np.unique(np.append(shift(task, before[inside], after[inside]), 0))


def headings(task: Task, line: Tracks, moves: IndexArray) -> IndexArray:
    """`[P]` modes at the points of closed tracks: twice the place in `moves`, 1 more after a stop."""
    cells, place = line.cells, np.arange(len(line.cells))
    number = np.zeros(len(cells), dtype=np.int64)
    number[1:] = shift(task, cells[:-1], cells[1:])
    number[line.first[:-1]] = 0
    begin = np.repeat(line.first[:-1], line.lengths)
    moved = np.maximum.accumulate(np.where((number != 0) | (place == begin), place, 0))
    return 2 * np.searchsorted(moves, number[moved]) + (moved < place)


def heading_after(
    task: Task, moves: IndexArray, mode: IndexArray, before: IndexArray, after: IndexArray
) -> IndexArray:
    """The modes after moves from cells `before` to cells `after`, see `headings`."""
    number = shift(task, before, after)
    return np.where(number == 0, mode // 2 * 2 + 1, 2 * np.searchsorted(moves, number))


def shift(task: Task, before: IndexArray, after: IndexArray) -> IndexArray:
    """One number for each pair of rows and columns moved, on C columns down · (2 C + 1) + across."""
    # Cell x in row i and column j is at i (2 C + 1) + j = x + i (C + 1): remainders would take twice as long again.
    down = after // task.columns - before // task.columns
    return after - before + down * (task.columns + 1)
