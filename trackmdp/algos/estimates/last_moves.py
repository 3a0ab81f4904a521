"""The motion where the next move depends on the cell and on the last moves, estimated from paths.

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
"""Moves as many as which the motion after one move less counts in that after a cell and its last moves; after none it
is the pooled motion of the cell."""


def displacements(task: Task, before: IndexArray, after: IndexArray) -> IndexArray:
    """`[H]`, the moves seen, each as one number (`shift`), in increasing order; 0 for a stop is always one."""
    inside = after < task.num_cells
    return np.unique(np.append(shift(task, before[inside], after[inside]), 0))


def after_moves(
    task: Task, tracks: Tracks, pooled: sparse.csr_array, least: float, depth: int = 1
) -> World:
    """The task with a target whose hidden mode is its last `depth` moves, and whether it has stopped since.

    A target that keeps its heading keeps it while it stops; one that stops at a border turns there.

    Args:
        task: sensors, prices, limits and memory.
        tracks: the paths.
        pooled: `[M, M + 1]` probabilities of moves from each cell, the last column the exit.
        least: moves less likely than that are left out.
        depth: moves that count.
    """
    cells, moves = task.num_cells, displacements(task, *tracks.steps(task.num_cells))
    base, rest = 2 * len(moves), 2 * int(np.searchsorted(moves, 0))
    line = tracks.closed(cells)
    heading = headings(task, line, moves)
    # Of a path a b c with the exit M: from b, after the move from a, to c.
    middle = np.ones(len(line.cells), dtype=bool)
    middle[line.first[:-1]] = middle[line.first[1:] - 1] = False
    at = np.flatnonzero(middle)
    # A mode is a number whose digits are headings, the last one lowest: after 3 and then 4 it is 3 base + 4.
    modes, resting, number, chances = np.zeros(1, dtype=np.int64), 0, np.zeros_like(heading), pooled
    for length in range(depth):
        previous = np.roll(number, 1)
        previous[line.first[:-1]] = resting
        shorter, number = modes, previous * base + heading
        # After moves never seen together the last one counts alone, as at the start of a path.
        alone = resting * base + np.arange(base)
        modes, resting = np.union1d(number[at], alone), resting * base + rest
        state = line.cells[at] * len(modes) + np.searchsorted(modes, number[at])
        shape = (cells * len(modes), cells + 1)
        counts = ones_at(state, line.cells[at + 1], shape, np.float64)
        above = np.searchsorted(shorter, modes % base**length)
        above = (np.arange(cells)[:, None] * len(shorter) + above).ravel()
        total = counts.sum(axis=1) + WEIGHT
        chances = sparse.diags_array(1.0 / total) @ (counts + WEIGHT * chances[above])
    row, to = row_index(chances), chances.indices
    before, mode = np.divmod(row, len(modes))
    # The pooled motion may hold moves never seen.
    kept = (to < cells) & np.isin(shift(task, before, to), moves)
    row, to, chance, before, mode = (
        each[kept] for each in (row, to, chances.data, before, modes[mode])
    )
    last = heading_after(task, moves, mode % base, before, to)
    after = mode % base ** (depth - 1) * base + last
    after = np.where(np.isin(after, modes), after, alone[last])
    entries = (chance, (row, to * len(modes) + np.searchsorted(modes, after)))
    kernel = sparse.csr_array(entries, shape=(cells * len(modes),) * 2)
    return World.of(task, without(kernel, least), modes=len(modes), max_steps=None)


def headings(task: Task, line: Tracks, moves: IndexArray) -> IndexArray:
    """`[P]` modes of `after_moves` at the points of closed tracks: twice the place in `moves`, 1 more after a stop."""
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
