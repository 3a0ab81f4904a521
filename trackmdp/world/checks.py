"""What makes a sparse matrix the kernel of a grid; sums over its rows, to the bit those of the dense one."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order

from trackmdp.config.sensing import LARGEST_PRICE
from trackmdp.errors import UserError

Range: TypeAlias = tuple[Callable[[npt.NDArray[np.float64]], npt.NDArray[np.bool_]], str]
"""Which of some numbers are allowed, and in words; a nan is in no range."""

PRICES: Range = (lambda price: (price >= 0) & (price <= LARGEST_PRICE), "a number from 0 to 1e15")
PROBABILITIES: Range = (lambda p: (p > 0) & (p <= 1), "a probability above 0, at most 1")

_LEAF = 128  # numpy adds up to so many numbers in one leaf of its summation tree
_LANES = 3  # log2 of the 8 interleaved partial sums of a leaf


def canonical_kernel(kernel: Any, source: str = "kernel") -> sparse.csr_array:
    """A table, sparse or dense, as a CSR matrix of float64 with sorted indices, no duplicates and no explicit zeros.

    Raises:
        UserError: it is no square table of real numbers; `source` is named at the start of the message.
    """
    table = kernel if sparse.issparse(kernel) else np.asarray(kernel)
    # bool, signed, unsigned, float: complex numbers would lose their imaginary part below.
    if table.dtype.kind not in "biuf":
        raise UserError(f"{source}: not a table of numbers (but of {table.dtype})")
    if table.ndim != 2 or table.shape[0] != table.shape[1]:
        raise UserError(f"{source}: expected a square table, got shape {table.shape}")
    canonical = sparse.csr_array(table, dtype=np.float64, copy=True)
    canonical.sum_duplicates()
    canonical.eliminate_zeros()
    return short_indices(canonical)


def short_indices(matrix: sparse.csr_array) -> sparse.csr_array:
    """The same matrix with int32 indices, where they are enough: half the memory, and products read half as much.

    SciPy takes the widest integer among what a matrix is made of, so that one array of int64 spreads to all.
    """
    if max(*matrix.shape, matrix.nnz) > np.iinfo(np.int32).max:
        return matrix
    pointers = (matrix.indices.astype(np.int32, copy=False), matrix.indptr.astype(np.int32, copy=False))
    return sparse.csr_array((matrix.data, *pointers), shape=matrix.shape)


def one_each(source: str, given: npt.ArrayLike, count: int, each: str, allowed: Range) -> npt.NDArray[np.float64]:
    """`[count]` numbers, from one for all or from one for each.

    Args:
        source: what messages begin with.
        given: a number, or a list.
        count: how many there are to be.
        each: what each is of: a cell, or a sensor.
        allowed: which of some numbers are in range, and the range in words.

    Raises:
        UserError: another number of numbers, or one out of range.
    """
    values = np.asarray(given, dtype=np.float64)
    if values.shape not in ((), (count,)):
        raise UserError(f"{source}: {values.size} values, expected one number or {count} (one per {each})")
    within, expected = allowed
    if not (fine := np.asarray(within(values))).all():
        bad = int(np.flatnonzero(~fine)[0])
        raise UserError(f"{source}: {each} {bad} has {values.flat[bad]}, expected {expected}")
    return np.broadcast_to(values, (count,)).copy()


def check_kernel(
    kernel: sparse.csr_array, size: tuple[int, int], *, truncates: bool, source: str = "kernel", modes: int = 1
) -> None:
    """See that `kernel` is one for this grid; else say which rule it breaks, and where.

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
        raise UserError(f"{source}: {m} rows, but a {rows}x{columns} grid has {rows * columns} cells")
    if not (finite := np.isfinite(kernel.data)).all():
        raise UserError(f"{source}: row {_row(kernel, ~finite)} holds a value that is not finite")
    if (negative := kernel.data < 0).any():
        raise UserError(f"{source}: row {_row(kernel, negative)} holds a negative probability")
    sums = pairwise_row_sums(kernel)
    if (high := sums > 1 + 1e-9).any():
        row = int(np.flatnonzero(high)[0])
        raise UserError(f"{source}: row {row} sums to {sums[row]:.6g}, expected at most 1 (the rest is the exit)")
    if not truncates and not (leaves := _can_exit(kernel, sums)).all():
        cell = int(np.flatnonzero(~leaves)[0]) // modes
        raise UserError(f"{source}: from cell {cell} the target never exits, so no episode ends; set grid.max_steps")


def _can_exit(kernel: sparse.csr_array, sums: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """`[M]` whether the exit can be reached from each cell: a search against the moves, from the exit."""
    # Vertex M is the exit; 1e-12 is rounding in a row that sums to 1. Edges are turned round, so that one search from M
    # reaches every cell that has a way out.
    m, leaves = kernel.shape[0], np.flatnonzero(sums < 1 - 1e-12)
    rows = np.repeat(np.arange(m), np.diff(kernel.indptr))
    back = np.concatenate([kernel.indices, np.full(len(leaves), m)]), np.concatenate([rows, leaves])
    graph = sparse.csr_array((np.ones(len(back[0]), dtype=np.int8), back), shape=(m + 1, m + 1))
    reached = np.zeros(m + 1, dtype=bool)
    reached[breadth_first_order(graph, m, return_predecessors=False)] = True
    return reached[:m]


def _row(kernel: sparse.csr_array, flags: npt.NDArray[np.bool_]) -> int:
    """The first row with a flagged entry."""
    return int(np.searchsorted(kernel.indptr, np.flatnonzero(flags)[0], side="right")) - 1


def pairwise_row_sums(matrix: sparse.csr_array) -> npt.NDArray[np.float64]:
    """`[B]` row sums, equal to those of ``matrix.toarray().sum(axis=1)`` to the bit.

    Whether a kernel is handed over dense or sparse must not show in a single digit. numpy adds pairwise: a row of M
    numbers is halved until at most 128 are left, those are added in 8 interleaved lanes, and all partial sums meet in
    a binary tree. Zeros change no sum, so only the entries climb that tree: `_leaves` gives each column a code whose
    bits are its way up, lanes first, and two partial sums of a row meet once their codes agree.
    """
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    codes = _codes(matrix.shape[1])[matrix.indices]
    order = np.lexsort((codes, rows))  # stable: within a lane in the order of the columns
    rows, codes, sums = rows[order], codes[order], matrix.data[order]
    rows, codes, sums = merged(rows, codes, sums)
    while len(codes) and codes.max() > 0:
        rows, codes, sums = merged(rows, codes >> 1, sums)
    total = np.zeros(matrix.shape[0])
    total[rows] = sums  # at the root a row has one sum left
    return total


def merged(rows: np.ndarray, codes: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Partial sums of one row and one code added up, in their order."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]) | (codes[1:] != codes[:-1])
    return rows[new], codes[new], np.bincount(np.cumsum(new) - 1, sums)


@lru_cache(maxsize=8)
def _codes(columns: int) -> npt.NDArray[np.int64]:
    """`[M]` the way of each column up numpy's summation tree, the lowest bit first.

    A leaf of 100 columns: columns 0 to 95 lie in the lanes 0, 1, ..., 7, 0, 1, ...; columns 96 to 99 are added one by
    one to the sum of the lanes, so they join at the levels 3, 4, 5 and 6. Only the last leaf has such a rest.
    """
    rest = columns % (1 << _LANES)
    leaves = _leaves(columns)
    depth = max(level for _, _, level, _ in leaves)
    codes = np.empty(columns, dtype=np.int64)
    for begin, end, level, place in leaves:
        lanes = np.arange(end - begin) % (1 << _LANES)
        if end == columns and rest:
            lanes[len(lanes) - rest :] = 1 << (_LANES + np.arange(rest))
        codes[begin:end] = lanes + (place << (depth - level + _LANES + rest))
    return codes


def _leaves(columns: int) -> list[tuple[int, int, int, int]]:
    """Begin, end, level and place in its level of each leaf, from the left."""
    waiting, leaves = [(0, columns, 0, 0)], []
    while waiting:
        begin, end, level, place = waiting.pop()
        if end - begin <= _LEAF:
            leaves.append((begin, end, level, place))
            continue
        half = (end - begin) // 2
        middle = begin + half - half % (1 << _LANES)  # numpy keeps the left half a multiple of 8
        waiting += [(middle, end, level + 1, 2 * place + 1), (begin, middle, level + 1, 2 * place)]
    return leaves
