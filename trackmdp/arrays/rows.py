"""Sums over the rows of a sparse matrix, to the bit those of the dense one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import row_index
from trackmdp.arrays.types import Array, Indices

_LEAF = 128  # numpy adds up to so many numbers in one leaf of its summation tree
_LANES = 3  # log2 of the 8 interleaved partial sums of a leaf


def pairwise_row_sums(matrix: sparse.csr_array) -> Array:
    """`[B]` row sums, equal to those of ``matrix.toarray().sum(axis=1)`` to the bit.

    Whether a kernel is handed over dense or sparse must not show in a single digit. numpy adds pairwise: a row of M
    numbers is halved until at most 128 are left, those are added in 8 interleaved lanes, and all partial sums meet in
    a binary tree. Zeros change no sum, so only the entries climb that tree: `_leaves` gives each column a code, its way
    up in bits, lanes first, and two partial sums of a row meet once their codes agree.
    """
    rows = row_index(matrix)
    codes = _codes(matrix.shape[1])[matrix.indices]
    order = np.lexsort((codes, rows))  # stable: within a lane in the order of the columns
    rows, codes, sums = rows[order], codes[order], matrix.data[order]
    rows, codes, sums = merged(rows, codes, sums)
    while len(codes) and codes.max() > 0:
        rows, codes, sums = merged(rows, codes >> 1, sums)
    total = np.zeros(matrix.shape[0])
    total[rows] = sums  # at the root a row has one sum left
    return total


def merged(
    rows: np.ndarray, codes: np.ndarray, sums: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Partial sums of one row and one code added up, in their order."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]) | (codes[1:] != codes[:-1])
    return rows[new], codes[new], np.bincount(np.cumsum(new) - 1, sums)


@lru_cache(maxsize=8)
def _codes(columns: int) -> Indices:
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
