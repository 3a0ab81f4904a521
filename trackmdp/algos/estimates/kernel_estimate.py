"""Estimate of the target's kernel from observations: detections, exits, and misses, which are censored moves.

After a miss the target is in one of the cells not sensed, or was missed by its sensor; nothing else is known.
Expectation-maximisation (Baum-Welch: a forward and a backward pass) replaces each path with misses by the expected
number of moves i -> j on it, so that estimates stay consistent when the sets were chosen rather than all sensors on.

Counts and kernels are sparse, `[M, M + 1]` with the exit in the last column: their memory follows the moves seen and
the moves of the prior, which puts the displacements seen anywhere down at every cell.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.algos.common import arrays, tensors
from trackmdp.algos.estimates.alike import AlikeCells
from trackmdp.algos.estimates.censored import ObservedPaths, each_once, expected_moves
from trackmdp.algos.estimates.shrinkage import posterior_mean, unseen
from trackmdp.arrays.entries import ones_at, per_row, row_index, with_data
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.grid.displacements import apart, cell_at, displacement
from trackmdp.grid.size import grid_size
from trackmdp.sensing.task import window_cells
from trackmdp.world.problem_file import as_arrays, from_arrays

_SETTLED = 1e-5
"""Share of all moves that a round counts elsewhere than the one before, below which no more rounds follow."""
_OPEN = 0.01
"""Weight, in the first round's kernel, of moves that were not seen yet."""
LEAST_EXIT = 1e-9
"""Exit probability of a kernel drawn from the posterior, at least."""
NEGLIGIBLE = 1e-3
"""Expected counts below this are dropped, so that the counts stay sparse."""
_PLACES = 2**22
"""Displacements put down at once: some 32 MB an array."""

_LONGEST_LEAP, _LEAST_LEFT = 16.0, 0.1
"""Of a leap over rounds: at most so far, in rounds, and the share of each count that is left at least."""

SELDOM = 0.1
"""Where a smaller share of the pairs so far apart was seen as moves, those moves come from a mixture of their own."""


class KernelEstimate:
    """Posterior of the kernel, row by row: Dirichlet over the next cell, Beta for the exit.

    The prior of a row is the target's mean behaviour, all rows pooled: the displacements seen so far, as far as they
    stay in the grid (where none does, all cells as near as the farthest move seen), and the pooled exit probability.

    Args:
        size: (rows, columns), or one number for a square.
        modes: H, where moves are between states cell · H + mode, which then stand for the cells in
            all that follows: as if the grid had H times as many columns, but displacements are those of one class.
        weight: the prior counts as much as this many moves.
        exit_weight: the pooled exit probability counts as much as this many moves.
        share_cells: whether the target moves alike from all cells away from the border, so that moves seen in one of
            them count for all; None: yes, except where the moves seen differ.
        classes: `[M]`, the class of each cell, cells of one class being alike; None: all are of one.

    Attributes:
        direct: `[M, M + 1]`, moves seen at once.
        counts: `[M, M + 1]`, moves seen, and those of censored paths at their expectation.
    """

    def __init__(
        self,
        size: int | tuple[int, int],
        *,
        weight: float,
        exit_weight: float,
        share_cells: bool | None = False,
        classes: IndexArray | None = None,
        modes: int = 1,
    ) -> None:
        self._modes = modes
        self.rows, self.columns = grid_size(size)
        self.columns *= modes
        self.weight = weight
        self.exit_weight = exit_weight
        self.share_cells = share_cells
        self._classes = classes
        self.num_cells = self.rows * self.columns
        self.direct = sparse.csr_array((self.num_cells, self.num_cells + 1))
        self.counts = self.direct
        self._censored: list[ObservedPaths] = []

    def add(self, paths: ObservedPaths) -> None:
        """Add observed `paths`."""
        # Without a miss both ends of the move are known; no expectation is needed, and the path itself need not be
        # kept.
        at_once = paths.misses == 0
        self.add_moves(paths.start[at_once], paths.end[at_once])
        if not at_once.all():
            self._censored.append(paths.pick(np.flatnonzero(~at_once)))

    def __len__(self) -> int:
        """Paths and moves added."""
        return round(self.direct.sum()) + sum(len(part.start) for part in self._censored)

    def add_moves(self, start: IndexArray, end: IndexArray) -> None:
        """Add moves `[K]` with both ends seen; `end` is M at the exit."""
        # Before the first fit the two are one matrix, and stay so; after it, counts wait for the next `fit`.
        unfitted = self.counts is self.direct
        self.direct = self.direct + ones_at(start, end, self.direct.shape, np.float64)
        self.counts = self.direct if unfitted else self.counts

    def state_dict(self) -> dict[str, Any]:
        """All that was observed, and the counts so far; none before the first fit."""
        parts = {"direct": self.direct}
        if self.counts is not self.direct:
            parts["counts"] = self.counts
        censored = [tensors(as_arrays(vars(part))) for part in self._censored]
        return tensors(as_arrays(parts)) | {"censored": censored}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        parts = dict(state)
        self._censored = [
            ObservedPaths(**from_arrays(arrays(each))) for each in parts.pop("censored")
        ]
        self.direct = (matrices := from_arrays(arrays(parts)))["direct"]
        # Without counts of their own, moves that are added count at once (`add_moves`).
        self.counts = matrices.get("counts", self.direct)

    def fit(self, rounds: int) -> None:
        """Run rounds of expectation-maximisation on the censored paths, from the kernel estimated so far.

        At most `rounds` of them: where few moves are censored their number hardly changes after a few; where most are,
        as with a budget, it would take hundreds, and every third one leaps to where they lead.

        The first round allows every move a little farther than any that must have been made: expectation-maximisation
        never leaves a probability of zero.
        """
        if not self._censored:
            self.counts = self.direct.copy()  # a fit of its own, without later additions
            return
        # Policies repeat themselves: equal paths have equal expectations, and are worked out once.
        paths, copies = each_once(ObservedPaths.of(self._censored, self.num_cells))
        kernel = (1.0 - _OPEN) * self.mean() + _OPEN * self._open_moves(paths)
        line: list[sparse.csr_array] = []
        for left in reversed(range(rounds)):
            before, self.counts = self.counts, self.direct + expected_moves(kernel, paths, copies)
            if abs(self.counts - before).sum() < _SETTLED * self.counts.sum():
                break
            line.append(self.counts)
            if left and len(line) == 3:
                self.counts, line = _leap(*line), []
            kernel = self.mean()
        counts = self.counts.copy()
        counts.data[counts.data < NEGLIGIBLE] = 0.0
        counts.eliminate_zeros()
        self.counts = counts

    def mean(self) -> sparse.csr_array:
        """`[M, M + 1]` posterior mean; the last column is the exit."""
        moves, exits = self._parameters()
        return self._kernel(moves, exits[0] / sum(exits))

    def believed(self, least: float = 0.0) -> sparse.csr_array:
        """`[M, M + 1]` posterior mean under a prior that is estimated as well, which plans are made on.

        Args:
            least: cells where a move that was not seen yet is less likely have none.

        The prior of `mean` weighs next to nothing and is the same at all moves; this one, of `shrinkage`, is estimated
        from the counts: how probabilities differ, and the share of moves not seen yet.
        """
        counts = self._pooled()
        exits, moved = self._exits(counts), counts[:, :-1]
        moved.eliminate_zeros()
        moved.sort_indices()  # `moved > 0` does, and `likely` is in the order of the entries
        rows, out = row_index(moved), moved.sum(axis=1)
        likely, seldom = np.zeros_like(moved.data), self._seldom(moved)
        for group in (seldom, ~seldom):
            likely[group] = posterior_mean(moved.data[group], out[rows[group]])
        # The shares of a cell add up to 1, which its estimates need not do.
        likely /= per_row(rows, likely, self.num_cells)[rows]
        new, stands_for = unseen(rows, likely, out[rows], self.num_cells)
        # A little of every displacement: a cell that was never left needs some, of any size.
        typical = self._typical_moves(moved, stands_for + 1e-12 * likely)
        typical = typical - typical.multiply(moved > 0)
        total = typical.sum(axis=1)
        share = np.divide(new, total, out=np.zeros_like(new), where=(total > 0) & (new >= least))
        # The rest is for the moves seen.
        scale = (1.0 - share * total)[rows]
        moves = with_data(moved, likely * scale) + sparse.diags_array(share) @ typical
        moves.eliminate_zeros()
        return self._kernel(moves, exits[0] / sum(exits))

    def samples(self, rng: np.random.Generator, count: int) -> Iterator[sparse.csr_array]:
        """`[M, M + 1]` kernels drawn from the posterior, censored paths taken at their expected moves."""
        moves, exits = self._parameters()
        # Cells that move alike are drawn once: the draws of many would average out.
        alike = None if self.share_cells is False else self._alike()
        for _ in range(count):
            # A Dirichlet draw is a row of gamma draws, scaled to 1; 1e-300 keeps a row of tiny parameters from 0 / 0.
            weights = with_data(moves, rng.standard_gamma(moves.data) + 1e-300)
            # Where exits are rare and few were seen most draws are 0 but for rounding, and an episode may never end.
            drawn = self._kernel(weights, np.maximum(rng.beta(*exits), LEAST_EXIT))
            yield drawn if alike is None else alike.spread(drawn)

    def _alike(self) -> AlikeCells:
        judged = self.counts if self.share_cells is None else None
        return AlikeCells(
            (self.rows, self.columns), self._farthest(self.counts[:, :-1]), judged, self._classes
        )

    @property
    def visits(self) -> Array:
        """`[M]` moves seen out of each cell, censored ones at their expectation."""
        return self.counts.sum(axis=1)

    def _kernel(self, moves: sparse.csr_array, leave: Array) -> sparse.csr_array:
        """`[M, M + 1]` from weights of the moves and `[M]` exit probabilities."""
        # The exit has a Beta of its own, and the moves share the rest: rows [stay, exit] sum to 1.
        scale = (1.0 - leave) / moves.sum(axis=1)
        stay = with_data(moves, moves.data * scale[row_index(moves)])
        return sparse.hstack([stay, sparse.csr_array(leave[:, None])], format="csr")

    def _pooled(self) -> sparse.csr_array:
        """`[M, M + 1]` counts, of cells that move alike together."""
        return self.counts if self.share_cells is False else self._alike().pooled(self.counts)

    def _parameters(self) -> tuple[sparse.csr_array, tuple[Array, Array]]:
        """Dirichlet parameters `[M, M]` of the moves and Beta parameters `[M]` of the exit."""
        counts = self._pooled()
        moved = counts[:, :-1]
        moves = moved + self.weight * self._typical_moves(moved)
        moves.eliminate_zeros()
        moves.sort_indices()  # draws are made entry by entry, row by row
        return moves, self._exits(counts)

    def _exits(self, counts: sparse.csr_array) -> tuple[Array, Array]:
        """Beta parameters `[M]` of the exit."""
        moved, left = counts[:, :-1].sum(axis=1), counts[:, [-1]].toarray()[:, 0]
        # half an exit in one more move keeps the pooled probability between 0 and 1 before any exit is seen
        pooled = (left.sum() + 0.5) / (counts.sum() + 1.0)
        # Beta(exits + w p, moves + w (1 - p)), with p the pooled exit probability and w the weight of the prior.
        return left + self.exit_weight * pooled, moved + self.exit_weight * (1 - pooled)

    def _open_moves(self, paths: ObservedPaths) -> sparse.csr_array:
        """`[M, M + 1]` uniform over the cells that one move may reach, judging by the fastest path seen."""
        inside = paths.end < self.num_cells
        gone = apart(self.columns, paths.start[inside], paths.end[inside])
        # A path that got 5 columns away with 1 miss made 2 moves, so one of them went at least ceil(5 / 2) = 3.
        fastest = np.ceil(gone / (paths.misses[inside] + 1)).max(initial=1)
        near = self._near(int(max(fastest, self._farthest(self.direct[:, :-1]))) + 1)
        return sparse.hstack([near, sparse.csr_array((self.num_cells, 1))], format="csr")

    def _typical_moves(
        self, moved: sparse.csr_array, weight: Array | None = None
    ) -> sparse.csr_array:
        """`[M, M]` pooled displacements applied at every cell, rows scaled to 1; cells without any get a neighbourhood.

        Args:
            moved: `[M, M]`, counts of moves.
            weight: of each stored entry; None for its share of the moves out of its cell.
        """
        start, end, data = row_index(moved), moved.indices, moved.data
        seen = data > 1e-9
        # Shares within each row, not counts: a cell the target visits often is no better evidence for the typical move
        # than others.
        weight = data / moved.sum(axis=1)[start] if weight is None else weight
        start, end, share = start[seen], end[seen], weight[seen]
        # On 10 x 10 cells, 2 rows down and 1 column to the left is the shift (2 + 10) · 20 + (-1 + 10) = 249.
        width = 2 * self.columns
        down, across = displacement(self.columns, start, end)
        shift = (down + self.rows) * width + across + self.columns
        # With modes the shift contains the mode as well: (cell, up) moves otherwise than (cell, left).
        shifts, place = np.unique(shift * self._modes + start % self._modes, return_inverse=True)
        each = np.bincount(place, weights=share, minlength=len(shifts)).astype(np.float64)
        shift, begin = np.divmod(shifts, self._modes)
        typical = self._put_down(
            shift // width - self.rows, shift % width - self.columns, each, begin
        )
        total = typical.sum(axis=1)
        without = np.flatnonzero(total <= 0)
        if len(without):
            near = self._near(self._farthest(moved))
            # A diagonal of ones at the rows where no displacement fits: keep @ near has the rows of `near` there, and
            # none elsewhere.
            keep = ones_at(without, without, near.shape, np.float64)
            typical, total = typical + keep @ near, np.where(total > 0, total, 1.0)
        return sparse.diags_array(1.0 / total) @ typical

    def _seldom(self, moved: sparse.csr_array) -> BoolArray:
        """`[E]` mask of long jumps among the `[M, M]` moves seen: distances that few moves have.

        They are fitted apart from the others.
        """
        columns, cells = self.columns // self._modes, self.num_cells // self._modes
        start, end = row_index(moved) // self._modes, moved.indices // self._modes
        each, place = np.unique(start * cells + end, return_inverse=True)
        gone, most = apart(columns, *np.divmod(each, cells)), max(self.rows, columns)
        # Pairs at most d apart: of n rows (2 d + 1) n - d (d + 1), d < n, and as many of the columns for each of them.
        up_to = np.ones(most + 1)
        for side in (self.rows, columns):
            d = np.minimum(np.arange(-1, most), side - 1)
            up_to *= (2 * d + 1) * side - d * (d + 1)
        up_to[0] = 0
        few = np.bincount(gone, minlength=most) < SELDOM * np.diff(up_to)
        return few[gone][place.ravel()]

    def _near(self, reach: int) -> sparse.csr_array:
        """`[M, M]` uniform over the cells up to `reach` rows and columns away."""
        near = window_cells((self.rows, self.columns), reach).astype(np.float64)
        return sparse.diags_array(1.0 / near.sum(axis=1)) @ near

    def _put_down(
        self, rows: IndexArray, columns: IndexArray, weight: Array, begin: IndexArray
    ) -> sparse.csr_array:
        """`[M, M]` displacements `[S]` from every cell of mode `begin` `[S]`, but for ends outside."""
        parts, count = [], max(1, _PLACES // max(1, len(weight)))
        for first in range(0, self.num_cells, count):
            cells = np.arange(first, min(first + count, self.num_cells))[:, None]
            row, column = cells // self.columns + rows, cells % self.columns + columns
            end, inside = cell_at((self.rows, self.columns), row, column)
            inside &= cells % self._modes == begin
            # [cells, S] in row-major order, as `end` below lists its entries.
            start, which = np.nonzero(inside)
            place, shape = (start, end[inside]), (len(cells), self.num_cells)
            parts.append(sparse.csr_array((weight[which], place), shape=shape))
        return sparse.vstack(parts, format="csr")

    def _farthest(self, moved: sparse.csr_array) -> int:
        """Rows or columns of the farthest move seen, at least 1."""
        return int(
            apart(self.columns, row_index(moved), moved.indices)[moved.data > 0].max(initial=1)
        )


def _leap(
    first: sparse.csr_array, second: sparse.csr_array, third: sparse.csr_array
) -> sparse.csr_array:
    """Where the counts of three rounds in a row lead: squared extrapolation (Varadhan and Roland 2008, SqS3).

    Example: in counts of 4, 6 and 7 each change is half of the one before. The step is |2| / |1 - 2| = 2, and the leap
    goes to where the changes end: 4 + 2 * 2 * 2 + 2 * 2 * (1 - 2) = 8.
    """
    change = second - first
    bend = third - second - change
    step = sparse.linalg.norm(change) / max(sparse.linalg.norm(bend), 1e-300)
    step = min(max(step, 1.0), _LONGEST_LEAP)
    far = (first + 2.0 * step * change + step**2 * bend).maximum(_LEAST_LEFT * third)
    return far * (third.sum() / far.sum())
