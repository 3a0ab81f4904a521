"""Unknown cells of whole paths, drawn where the next move depends on the cell and on the last move.

A kernel of the cell alone takes an unknown step of a target that keeps its heading for a turn as often as not. Gibbs
sampling draws each unknown cell given the cells around it, and counts the moves anew after each sweep (stochastic
expectation-maximisation, Celeux and Diebolt 1985). What a stop tells of moves three steps later is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.entries import among, distinct
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.grid.displacements import cell_at
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.task import Task

_SWEEPS = 20
_MOST_MOVES = 50
"""Displacements up to which cells are drawn so: after a longer leap the last move hardly predicts the next."""
_LEAP = 1e-6
"""Probability of any other move: guesses that no draw would hold for possible can be left one by one."""
_WEIGHT = 3.0
"""Moves as many as which those from a cell, after any move, count among those after the last one."""
_AT_ONCE = 2**21
"""Unknown cells times displacements worked on at once: some 20 MB an array."""

Missed: TypeAlias = Callable[[IndexArray, IndexArray], Array]
"""From numbers of unknown cells `[K]` and cells `[K, H]` to the probability of a miss there, `[K, H]`."""


def redrawn(
    task: Task, line: Tracks, unknown: BoolArray, missed: Missed, rng: np.random.Generator
) -> IndexArray:
    """`[P]` cells of tracks, M after an exit, the `unknown` ones drawn anew; no track begins or ends with one.

    Example: on cells in a row a target that came from 2 to 3 is located in 5 two steps later. It was in 4 then if it
    keeps its heading, in 3 if it stopped and then leapt.

    Args:
        task: its grid.
        line: the tracks, with first guesses.
        unknown: `[P]`.
        missed: probability that the target was not reported, by numbers among the unknown cells.
        rng: of the draws.
    """
    at, line = np.flatnonzero(unknown), replace(line, cells=line.cells.copy())
    for _ in range(_SWEEPS):
        moves = Moves(task, line, unknown)
        if len(moves.moves) > _MOST_MOVES:
            break
        # A draw looks at the next two cells: every third one is drawn at once.
        for turn in range(3):
            own = np.flatnonzero(at % 3 == turn)
            if not len(own):
                continue
            mode = moves.headings(line)
            for part in np.array_split(own, 1 + len(own) * len(moves.moves) // _AT_ONCE):
                place = at[part]
                chance = moves.likelihood(line, mode, place)
                chance *= missed(part, moves.candidates(line.cells[place - 1])[0])
                line.cells[place] = moves.picked(line, place, chance, rng.random(len(place)))
    return line.cells


class Moves:
    """How often cells followed each other on complete tracks; displacements that were never sensed do not count.

    Args:
        task: its grid.
        line: the tracks.
        unknown: `[P]`, which of their cells were not sensed.

    Attributes:
        moves: `[H]`, the displacements sensed, each as one number (`shift`), in increasing order; 0 for a stop is
            always one.
    """

    def __init__(self, task: Task, line: Tracks, unknown: BoolArray) -> None:
        self._size, self._cells = task.size, task.num_cells
        goes_on = np.ones(len(line.cells), bool)
        goes_on[line.first[1:] - 1] = False
        at = np.flatnonzero(goes_on)
        before, after = line.cells[at], line.cells[at + 1]
        number, inside = self.shift(before, after), after < self._cells
        sensed = ~(unknown[at] | unknown[at + 1])
        sensed |= not sensed.any()
        self.moves = distinct(np.append(number[sensed & inside], 0))
        possible = ~inside | np.isin(number, self.moves)
        at, before, after = at[possible], before[possible], after[possible]
        codes = self._codes(before, self.headings(line)[at], after)
        # How often a cell (b), with its heading (m) and with the next cell (c), came before a next cell: the codes that
        # came, in order, and their numbers.
        self._counts = {name: np.unique(each, return_counts=True) for name, each in codes.items()}

    def shift(self, before: IndexArray, after: IndexArray) -> IndexArray:
        """One number for each pair of rows and columns moved, on C columns down · (2 C + 1) + across."""
        # Cell x in row i and column j is at i (2 C + 1) + j = x + i (C + 1): remainders would take twice as long again.
        columns = self._size[1]
        down = after // columns - before // columns
        return after - before + down * (columns + 1)

    def headings(self, line: Tracks) -> IndexArray:
        """`[P]` modes at the points of closed tracks: twice the place in `moves`, 1 more after a stop."""
        cells, place = line.cells, np.arange(len(line.cells))
        number = np.zeros(len(cells), np.int64)
        number[1:] = self.shift(cells[:-1], cells[1:])
        number[line.first[:-1]] = 0
        begin = np.repeat(line.first[:-1], line.lengths)
        moved = np.maximum.accumulate(np.where((number != 0) | (place == begin), place, 0))
        return 2 * np.searchsorted(self.moves, number[moved]) + (moved < place)

    def heading_after(self, mode: IndexArray, before: IndexArray, after: IndexArray) -> IndexArray:
        """The modes after moves from cells `before` to cells `after`, see `headings`."""
        number = self.shift(before, after)
        return np.where(number == 0, mode // 2 * 2 + 1, 2 * np.searchsorted(self.moves, number))

    def candidates(self, last: IndexArray) -> tuple[IndexArray, BoolArray]:
        """`[K, H]` cells that the `moves` lead to from cells `last` `[K]`, and whether they are in the grid."""
        columns = self._size[1]
        down, across = np.divmod(self.moves + columns, 2 * columns + 1)
        row, column = last[:, None] // columns + down, last[:, None] % columns + across - columns
        cell, inside = cell_at(self._size, row, column)
        return np.where(inside, cell, 0), inside

    def likelihood(self, line: Tracks, mode: IndexArray, at: IndexArray) -> Array:
        """`[K, H]` probability of the `candidates` at the places `at` and of the next two cells, but for a factor."""
        last, after, known = line.cells[at - 1], line.cells[at + 1][:, None], mode[at - 1][:, None]
        cell, inside = self.candidates(last)
        place = np.minimum(at + 2, len(line.cells) - 1)
        ends = np.isin(at + 2, line.first)  # the next cell is the track's last one
        later, last = line.cells[place][:, None], last[:, None]
        then = self.heading_after(known, last, cell)
        chance = self._chance(last, known, cell) * self._chance(cell, then, after)
        afterwards = self.heading_after(then, cell, after)
        chance *= np.where(ends[:, None], 1.0, self._chance(after, afterwards, later))
        return chance * inside

    def picked(self, line: Tracks, at: IndexArray, chance: Array, draws: Array) -> IndexArray:
        """`[K]` cells in proportion to `chance` `[K, H]`; where nothing is possible, those before."""
        sums = chance.cumsum(axis=1)
        pick = (draws[:, None] * sums[:, -1:] >= sums).sum(axis=1).clip(max=chance.shape[1] - 1)
        cell = self.candidates(line.cells[at - 1])[0][np.arange(len(at)), pick]
        return np.where(sums[:, -1] > 0, cell, line.cells[at])

    def _chance(self, cell: IndexArray, mode: IndexArray, after: IndexArray) -> Array:
        """Probability of the next cell."""
        count = {}
        for name, wanted in self._codes(cell, mode, after).items():
            came, times = self._counts[name]
            place, known = among(came, wanted)
            count[name] = np.where(known, times[place], 0)
        alone: Array = count["bc"] / np.maximum(count["b"], 1.0)
        return (count["bmc"] + _WEIGHT * alone) / (count["bm"] + _WEIGHT) + _LEAP

    def _codes(
        self, cell: IndexArray, mode: IndexArray, after: IndexArray
    ) -> dict[str, IndexArray]:
        """One number for each combination of cells and modes; a move that was never seen has a mode of its own."""
        known, wide = cell * (2 * len(self.moves) + 2) + mode, self._cells + 1
        return {"b": cell, "bc": cell * wide + after, "bm": known, "bmc": known * wide + after}
