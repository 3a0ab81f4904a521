"""Checks of kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order

from trackmdp.arrays.entries import ones_at, row_index, row_sums
from trackmdp.arrays.numbers import canonical
from trackmdp.errors import UserError


def canonical_kernel(kernel: Any, source: str = "kernel") -> sparse.csr_array:
    """A table, sparse or dense, as a CSR matrix of float64 with sorted indices, no duplicates and no explicit zeros.

    Raises:
        UserError: it is no square table of real numbers, or its indices lead out of it; `source` is named at the start
            of the message.
    """
    expected = "a square table"
    table = canonical(source, kernel, expected)
    if table.shape[0] != table.shape[1]:
        raise UserError(f"{source}: expected {expected}, got shape {table.shape}")
    return table


def check_kernel(
    kernel: sparse.csr_array,
    size: tuple[int, int],
    *,
    truncates: bool,
    source: str = "kernel",
    modes: int = 1,
) -> None:
    """Check that `kernel` is one for this grid; the error names the broken rule and the place.

    Args:
        kernel: canonical candidate `[M, M]`.
        size: (rows, columns); M is their product.
        truncates: whether episodes are truncated; if not, the target must be able to exit from anywhere.
        source: named at the start of the message.
        modes: states in each cell, one after the other.

    Raises:
        UserError: a rule is broken.
    """
    m, (rows, columns) = kernel.shape[0], size
    if m != rows * columns:
        raise UserError(
            f"{source}: {m} rows, but a {rows}x{columns} grid has {rows * columns} cells"
        )
    if not (finite := np.isfinite(kernel.data)).all():
        raise UserError(f"{source}: row {_row(kernel, ~finite)} holds a value that is not finite")
    if (negative := kernel.data < 0).any():
        raise UserError(f"{source}: row {_row(kernel, negative)} holds a negative probability")
    with np.errstate(over="ignore"):  # inf is too high, and refused as such
        sums = row_sums(kernel)
    if (high := sums > 1 + 1e-9).any():
        row = int(np.flatnonzero(high)[0])
        raise UserError(
            f"{source}: row {row} sums to {sums[row]:.6g}, expected at most 1 (the rest is the exit)"
        )
    if not truncates and not (leaves := _can_exit(kernel, sums)).all():
        cell = int(np.flatnonzero(~leaves)[0]) // modes
        raise UserError(
            f"{source}: from cell {cell} the target never exits, so no episode ends; expected a way out of every cell, "
            "or grid.max_steps where policies are learned or simulated (only whole episodes are solved)"
        )


def _can_exit(kernel: sparse.csr_array, sums: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """`[M]` whether the exit can be reached from each cell: a search against the moves, from the exit."""
    # Vertex M is the exit; 1e-12 is rounding in a row that sums to 1. Edges are turned round, so that one search from M
    # reaches every cell that has a way out.
    m, leaves = kernel.shape[0], np.flatnonzero(sums < 1 - 1e-12)
    before = np.concatenate([kernel.indices, np.full(len(leaves), m)])
    after = np.concatenate([row_index(kernel), leaves])
    graph = ones_at(before, after, (m + 1, m + 1), np.int8)
    reached = np.zeros(m + 1, bool)
    reached[breadth_first_order(graph, m, return_predecessors=False)] = True
    return reached[:m]


def _row(kernel: sparse.csr_array, flags: npt.NDArray[np.bool_]) -> int:
    """The first row with a flagged entry."""
    return int(np.searchsorted(kernel.indptr, np.flatnonzero(flags)[0], side="right")) - 1
