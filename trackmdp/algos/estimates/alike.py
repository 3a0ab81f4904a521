"""Cells from which the target moves alike: their moves are pooled, displacement by displacement."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, row_index, with_data
from trackmdp.arrays.files import read_numbers
from trackmdp.arrays.types import BoolArray, IndexArray
from trackmdp.errors import UserError

DEVIATIONS = 4.0
"""Standard deviations by which a test of homogeneity has to be exceeded for a group of cells to be split up."""


def cell_classes(share: str | None, size: tuple[int, int]) -> IndexArray | None:
    """`[M]`, the class of each cell, by `algo.share_cells`; None where no two cells count as alike.

    Raises:
        UserError: its file does not hold one whole number for each cell of a grid of `size`.
    """
    if share is None or share == "none":
        return None
    if share == "all":
        return np.zeros(size[0] * size[1], np.int64)
    given = read_numbers("algo.share_cells", share, name="classes")
    cells = size[0] * size[1]
    # Up to 2^53 a float is the whole number that was written; beyond 2^63 two classes would become one.
    whole = (given == np.round(given)) & (np.abs(given) < 2**53)
    # (cells, 1): a .csv file with one number in a line.
    if given.shape not in ((cells,), (cells, 1), size) or not whole.all():
        expected = f"{cells} or {size[0]} x {size[1]} whole numbers, the class of each cell"
        shape = " x ".join(map(str, given.shape))
        raise UserError(f"algo.share_cells={share}: expected {expected}, got {given.dtype} {shape}")
    return given.ravel().astype(np.int64)


class AlikeCells:
    """Groups of cells of one class that are equally far from each border, or farther than the target moves.

    Args:
        size: (rows, columns) of the grid.
        reach: rows or columns that the target moves in one step, at most.
        counts: `[M, M + 1]`, moves seen out of each cell: groups are split up where the moves of their cells differ.
        classes: `[M]`, the class of each cell; None: they are all of one.

    Attributes:
        groups: `[M]`, the group of each cell.
        first: `[G]`, the first cell of each group.
    """

    def __init__(
        self,
        size: tuple[int, int],
        reach: int,
        counts: sparse.csr_array | None = None,
        classes: IndexArray | None = None,
    ) -> None:
        rows, columns = size
        row, column = np.divmod(np.arange(rows * columns), columns)
        # Distances to the four borders, up to the reach. On 5 x 5 cells with reach 1, the 9 inner cells are of one
        # group, the 3 cells between two corners of another one for each border, and each corner is alone.
        margins = np.stack([row, rows - 1 - row, column, columns - 1 - column], axis=1)
        margins = np.minimum(margins, reach)
        features = margins if classes is None else np.column_stack([margins, classes])
        _, first, groups = np.unique(features, axis=0, return_index=True, return_inverse=True)
        self.first, self.groups = first, groups.ravel()
        if counts is not None:
            apart = self._told_apart(counts)[self.groups]
            # Cells of a group that is split up get numbers behind those of all groups.
            labels = np.where(apart, len(first) + np.arange(len(row)), self.groups)
            _, self.first, self.groups = np.unique(labels, return_index=True, return_inverse=True)

    def _told_apart(self, counts: sparse.csr_array) -> BoolArray:
        """`[G]` whether the moves seen out of the cells of a group differ by more than chance, in Pearson's test."""
        expected = self.pooled(counts)
        # Misses leave traces of moves that nobody may have made, and 1 / E of a millionth would be a million below.
        made = expected >= 1.0
        counts, expected = (each.multiply(made) for each in (counts, expected))
        out, together = counts.sum(axis=1), expected.sum(axis=1)
        # E = n_x (the group's share of the move). The sum of (O - E)² / E over entries is that of O² / E less that of
        # O, and entries of the group that were not seen out of a cell take part with O = 0.
        rows = row_index(expected)
        share = (out / np.maximum(together, 1e-300))[rows]
        expected = with_data(expected, expected.data * share)
        # Misses leave shares of 1e-310 of a move, whose inverse would be infinite.
        seen = expected.data > 1e-100
        inverse = sparse.csr_array(
            (1.0 / expected.data[seen], (rows[seen], expected.indices[seen])), shape=counts.shape
        )
        statistic = per_row(
            self.groups,
            (counts.multiply(counts).multiply(inverse)).sum(axis=1) - out,
            len(self.first),
        )
        # Its mean is (cells - 1) (moves - 1), its variance twice that and the sum of all 1 / E, where few are expected.
        cells = per_row(self.groups, (out > 0).astype(float), len(self.first))
        moves = np.diff(expected.indptr)[self.first]
        freedom = np.maximum(cells - 1, 0) * np.maximum(moves - 1, 0)
        variance = 2.0 * freedom + per_row(self.groups, inverse.sum(axis=1), len(self.first))
        return statistic > freedom + DEVIATIONS * np.sqrt(variance)

    def pooled(self, counts: sparse.csr_array) -> sparse.csr_array:
        """`[M, M + 1]` counts of moves, each cell's being those of its whole group; the last column is the exit."""
        m, (start, end) = len(self.groups), (row_index(counts), counts.indices)
        # Within a group a difference of cell numbers is one displacement: across a row either the column is the same
        # for all, or both borders are farther away than any move. The exit has a number beyond all differences.
        shifts, place = np.unique(np.where(end == m, m, end - start), return_inverse=True)
        shape = (len(self.first), len(shifts))
        each = sparse.csr_array((counts.data, (self.groups[start], place)), shape=shape)
        each = each[self.groups]
        start, shift = row_index(each), shifts[each.indices]
        end = np.where(shift == m, m, start + shift)
        return sparse.csr_array((each.data, (start, end)), shape=counts.shape)

    def spread(self, kernel: sparse.csr_array) -> sparse.csr_array:
        """`[M, M + 1]` with the row of the first cell of each group, moved to all the others'."""
        kept = np.zeros(len(self.groups))
        kept[self.first] = 1.0
        return self.pooled(sparse.diags_array(kept) @ kernel)
