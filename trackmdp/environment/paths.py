"""Sampled paths of targets, by a motion model or along recorded tracks.

The place of a target, int64, is its hidden state: its cell, its cell and mode, or a point of a recorded track.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.errors import UserError
from trackmdp.motion.chain import Motion
from trackmdp.world.problem import Problem

RESOLUTION = 2**40
"""A draw is a whole number below 2^40; sampled and given probabilities of a successor differ by less than 2^-40."""

_SHORT = 32
"""Entries of the longest row up to which rows are padded to one length."""

_MOST_STATES = 2**23 - 2
"""(Z + 1) · 2^40, the end of the line of longer rows, must be an int64."""


class PathSampler:
    """Samples paths of a Markov chain of Z states: z' ~ moves(z, ·); state Z is the exit, and stays there.

    Each row of `moves`, closed by the exit, divides [0, 2^40) among its successors in proportion to their
    probabilities. A binary search for a draw among the upper ends of these intervals gives the successor, for any
    support of the row. All ends are whole numbers, so that the search is exact.

    Args:
        motion: the chain.
        num_cells: M, the cell of the exit.
        device: device of the tables.

    Attributes:
        starts: F.

    Raises:
        UserError: there are too many states for exact sampling.
    """

    def __init__(self, motion: Motion, num_cells: int, device: torch.device | str = "cpu") -> None:
        states, device = motion.num_states, torch.device(device)
        self.device, self.num_states, self.modes = device, states, motion.modes
        self.starts = len(motion.first)
        # None where episodes start in all states, where each is the cell of its number, and where no recording stops.
        # The tables of cells and of ends have an entry of the exit.
        self._first = self._cells = self._ends = None
        if self.starts < states:
            self._first = torch.as_tensor(motion.first.astype(np.int64), device=device)
        if not np.array_equal(motion.cell, np.arange(num_cells)):
            cells = np.append(motion.cell.astype(np.int64), num_cells)
            self._cells = torch.as_tensor(cells, device=device)
        if motion.ends is not None:
            self._ends = torch.as_tensor(np.append(motion.ends, False), device=device)
        self._make_edges(motion.moves)

    def _make_edges(self, moves: sparse.csr_array) -> None:
        """Upper ends of the intervals, and the successor of each."""
        # Worked example, two cells, in units of 2^40: P_01 = .5, P_10 = .25, P_11 = .5. The ends within the rows are .5
        # and .25, .75. Each row is closed by the exit, state 2, at 1, and the row of the exit is 1 alone: ends
        # .5 1, .25 .75 1 and 1, successors 1 2, 0 1 2 and 2. A row that sums to 1, up to rounding, leaves the exit
        # nothing.
        states, counts = self.num_states, np.diff(moves.indptr)
        # A successor with an interval up to e is drawn for u < e; with u = k / 2^40 for k < ceil(e · 2^40), exactly.
        inner = np.ceil(np.minimum(_running_sums(moves), 1.0) * RESOLUTION).astype(np.int64)
        ends = np.append(np.insert(inner, moves.indptr[1:], RESOLUTION), RESOLUTION)
        following = np.insert(moves.indices.astype(np.int64), moves.indptr[1:], states)
        following = np.append(following, states)
        lengths = np.append(counts + 1, 1)
        self._length = int(lengths.max()) if lengths.max() <= _SHORT + 1 else None
        if self._length is None:
            if states > _MOST_STATES:
                raise UserError(f"kernel: {states:,} states, expected at most {_MOST_STATES:,}")
            # All rows end to end on one line: state z owns [z · 2^40, (z + 1) · 2^40).
            ends += np.repeat(np.arange(states + 1) * RESOLUTION, lengths)
        else:
            # Padded to one length, which reads far less than a search on the line of a large grid.
            filled = np.arange(self._length) < lengths[:, None]
            tables = np.full((2, *filled.shape), [[[RESOLUTION]], [[states]]])
            tables[:, filled] = ends, following
            ends, following = tables
        self._edges = torch.as_tensor(ends, device=self.device)
        self._successors = torch.as_tensor(following.ravel(), device=self.device)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`[count]` int64 draws below `RESOLUTION`, for `move`."""
        return torch.randint(RESOLUTION, (count,), generator=generator, device=self.device)

    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        """`[B]` next places of targets in `place` `[B]` for `draws` `[B]`; Z after an exit."""
        # right=True: an end is the first draw that no longer belongs to its successor.
        if self._length is None:
            line = torch.add(draws, place, alpha=RESOLUTION)
            found = torch.searchsorted(self._edges, line, right=True)
        else:
            edges = self._edges.index_select(0, place)
            found = torch.searchsorted(edges, draws.unsqueeze(1), right=True).squeeze(1)
            found = found.add_(place, alpha=self._length)
        return self._successors.index_select(0, found)

    def begin(self, numbers: Tensor) -> Tensor:
        """`[B]` places of the starts `numbers` `[B]`."""
        return numbers if self._first is None else self._first[numbers]

    def cell(self, place: Tensor) -> Tensor:
        """`[B]` cells of targets in `place` `[B]`; M after an exit."""
        return place if self._cells is None else self._cells.index_select(0, place)

    def mode(self, place: Tensor) -> Tensor | None:
        """`[B]` modes of targets in `place` `[B]`, -1 after an exit; None where targets have none."""
        if self.modes == 1:
            return None
        return torch.where(place < self.num_states, place % self.modes, -1)

    def stops(self, place: Tensor) -> Tensor | None:
        """`[B]` bool, whether the recording stops in `place` `[B]`; None where none does."""
        return None if self._ends is None else self._ends.index_select(0, place)


def _running_sums(moves: sparse.csr_array) -> npt.NDArray[np.float64]:
    """`[nnz]`, for each entry the sum of its row up to and including it, added from left to right."""
    sums, lengths = moves.data.astype(np.float64), np.diff(moves.indptr)
    # One pass for each place in a row: one running sum over all entries would round differently in each row.
    for place in range(1, int(lengths.max(initial=0))):
        entry = moves.indptr[:-1][lengths > place] + place
        sums[entry] += sums[entry - 1]
    return sums


def path_sampler(
    problem: Problem, device: torch.device | str = "cpu", *, held_out: bool = False
) -> PathSampler:
    """Paths of a world's targets, or along the tracks of a `Recorded` to learn from or, on request, held out."""
    return PathSampler(problem.sampled(held_out=held_out), problem.num_cells, device)
