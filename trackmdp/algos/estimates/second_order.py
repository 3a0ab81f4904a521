"""The motion where the next move depends on the cell and on the last move, estimated from paths.

Targets with a heading or a velocity move much like that. Policy iteration on paths stops at plans of which no part can
change alone for the better; a plan for this motion, which the solver searches on far fewer states, is another start.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.shrinkage import without
from trackmdp.solvers.linear import IndexArray, row_index
from trackmdp.world.model import Task, World
from trackmdp.world.tracks import Tracks

_WEIGHT = 3.0
"""Moves as many as which the pooled motion of the cell counts in the motion after a cell and a move."""


def displacements(task: Task, tracks: Tracks) -> IndexArray:
    """`[H]`, the moves seen, each as one number (`_number`), in increasing order."""
    before, after = tracks.steps(task.num_cells)
    inside = after < task.num_cells
    return np.unique(_number(task, before[inside], after[inside]))


def second_order(task: Task, tracks: Tracks, pooled: sparse.csr_array, least: float) -> World:
    """The task with a target whose hidden mode is its last move.

    Args:
        task: sensors, prices, limits and memory.
        tracks: the paths.
        pooled: `[M, M + 1]` probabilities of moves from each cell, the last column the exit.
        least: moves less likely than that are left out.
    """
    cells, moves = task.num_cells, displacements(task, tracks)
    modes = len(moves)
    # Of a path a b c with the exit M: a to b, and then from b, after that move, to c.
    line = tracks.closed(cells)
    middle = np.ones(len(line.cells), dtype=bool)
    middle[line.first[:-1]] = middle[line.first[1:] - 1] = False
    at = np.flatnonzero(middle)
    a, b, c = (line.cells[at + shift] for shift in (-1, 0, 1))
    state = b * modes + np.searchsorted(moves, _number(task, a, b))
    shape = (cells * modes, cells + 1)
    counts = sparse.csr_array((np.ones(len(at)), (state, c)), shape=shape)
    prior = _WEIGHT * pooled[np.repeat(np.arange(cells), modes)]
    total = np.asarray(counts.sum(axis=1)).ravel() + _WEIGHT
    chance = sparse.csr_array(sparse.diags_array(1.0 / total) @ (counts + prior))
    row, to = row_index(chance), chance.indices
    number = _number(task, row // modes, to)
    mode = np.minimum(np.searchsorted(moves, number), modes - 1)
    kept = (to < cells) & (moves[mode] == number)  # the pooled motion may hold moves never seen
    entries = (chance.data[kept], (row[kept], (to * modes + mode)[kept]))
    kernel = sparse.csr_array(entries, shape=(cells * modes, cells * modes))
    return World.of(task, without(kernel, least), modes=modes, max_steps=None)


def _number(task: Task, before: IndexArray, after: IndexArray) -> IndexArray:
    """One number for each pair of rows and columns moved."""
    down = after // task.columns - before // task.columns
    across = after % task.columns - before % task.columns
    return down * (2 * task.columns + 1) + across
