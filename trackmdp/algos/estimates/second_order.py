"""The motion where the next move depends on the cell and on the last move, estimated from paths.

Targets with a heading or a velocity move much like that. Policy iteration on paths stops at plans of which no part can
change alone for the better; a plan for this motion, which the solver searches on far fewer states, is another start.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.shrinkage import without
from trackmdp.arrays.entries import ones_at, row_index
from trackmdp.arrays.types import IndexArray
from trackmdp.grid.displacements import displacement
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.task import Task
from trackmdp.world.model import World

WEIGHT = 3.0
"""Moves as many as which the pooled motion of the cell counts in the motion after a cell and a move."""


def displacements(task: Task, before: IndexArray, after: IndexArray) -> IndexArray:
    """`[H]`, the moves seen, each as one number (`shift`), in increasing order; 0 for a stop is always one."""
    inside = after < task.num_cells
    return np.unique(np.append(shift(task, before[inside], after[inside]), 0))


def second_order(task: Task, tracks: Tracks, pooled: sparse.csr_array, least: float) -> World:
    """The task with a target whose hidden mode is its last move, and whether it has stopped since.

    A target that keeps its heading keeps it while it stops; one that stops at a border turns there.

    Args:
        task: sensors, prices, limits and memory.
        tracks: the paths.
        pooled: `[M, M + 1]` probabilities of moves from each cell, the last column the exit.
        least: moves less likely than that are left out.
    """
    cells, moves = task.num_cells, displacements(task, *tracks.steps(task.num_cells))
    modes = 2 * len(moves)
    line = tracks.closed(cells)
    mode = headings(task, line, moves)
    # Of a path a b c with the exit M: from b, after the move from a, to c.
    middle = np.ones(len(line.cells), dtype=bool)
    middle[line.first[:-1]] = middle[line.first[1:] - 1] = False
    at = np.flatnonzero(middle)
    state, shape = line.cells[at] * modes + mode[at], (cells * modes, cells + 1)
    counts = ones_at(state, line.cells[at + 1], shape, np.float64)
    prior = WEIGHT * pooled[np.repeat(np.arange(cells), modes)]
    total = counts.sum(axis=1) + WEIGHT
    chances = sparse.diags_array(1.0 / total) @ (counts + prior)
    row, to = row_index(chances), chances.indices
    # The pooled motion may hold moves never seen.
    kept = (to < cells) & np.isin(shift(task, row // modes, to), moves)
    row, to, chance = row[kept], to[kept], chances.data[kept]
    after = heading_after(task, moves, row % modes, row // modes, to)
    entries = (chance, (row, to * modes + after))
    kernel = sparse.csr_array(entries, shape=(cells * modes, cells * modes))
    return World.of(task, without(kernel, least), modes=modes, max_steps=None)


def headings(task: Task, line: Tracks, moves: IndexArray) -> IndexArray:
    """`[P]` modes of `second_order` at the points of closed tracks: twice the place in `moves`, 1 more after a stop."""
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
    """One number for each pair of rows and columns moved."""
    down, across = displacement(task.columns, before, after)
    return down * (2 * task.columns + 1) + across
