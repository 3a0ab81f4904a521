"""Sparse matrices entry by entry: rows of entries, other numbers in the same places, matrices of ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import AnyArray, Array, BoolArray, IndexArray, Indices

# Numbers of a matrix whose rows are added up as those of a dense one, 32 MB: kernels of up to 2,048 states.
_SMALL = 2**22


def row_index(matrix: sparse.csr_array) -> IndexArray:
    """`[nnz]` the row of each stored entry."""
    # indptr = (0, 2, 2, 5) has rows of 2, 0 and 3 entries: 0 0 2 2 2. int64, so that row · M + cell never overflows.
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def with_data(matrix: sparse.csr_array, data: AnyArray) -> sparse.csr_array:
    """The same entries with other numbers `[nnz]`; their places are shared, not copied."""
    return sparse.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


def index_type(count: int) -> type[np.int32] | type[np.int64]:
    """int32 where it is enough: half the memory."""
    return np.int32 if count <= np.iinfo(np.int32).max else np.int64


def short_indices(matrix: sparse.csr_array) -> sparse.csr_array:
    """The same matrix with int32 indices, where they are enough: half the memory, and products read half as much.

    SciPy takes the widest integer among a matrix's parts, so that one array of int64 spreads to all.
    """
    kind = index_type(max(*matrix.shape, matrix.nnz))
    pointers = (each.astype(kind, copy=False) for each in (matrix.indices, matrix.indptr))
    return sparse.csr_array((matrix.data, *pointers), shape=matrix.shape)


def ones_at(
    rows: IndexArray, columns: IndexArray, shape: tuple[int, int], kind: Any = np.bool_
) -> sparse.csr_array:
    """Ones in these places `[E]`, true or as numbers of a `kind`, of which those in one place are added up."""
    return sparse.csr_array((np.ones(len(rows), kind), (rows, columns)), shape=shape)


def summing(index: IndexArray, count: int) -> sparse.csr_array:
    """`[count, E]` 0/1 matrix that sums over the entries of each `index` `[E]`."""
    return ones_at(index, np.arange(len(index)), (count, len(index)), np.float64)


def per_row(rows: IndexArray, values: Array, count: int) -> Array:
    """`[count]` sums of `values` over equal `rows`."""
    return np.bincount(rows, weights=values, minlength=count).astype(np.float64, copy=False)


def row_sums(matrix: sparse.csr_array) -> Array:
    """`[R]` sums of the rows."""
    # NumPy adds dense rows pairwise: so a small kernel, sparse or written out, has the same sums to the bit.
    small = math.prod(matrix.shape) <= _SMALL
    return np.asarray((matrix.toarray() if small else matrix).sum(axis=1))


def padded_rows(
    matrix: sparse.csr_array, none: int = 0, *, more: int = 0
) -> tuple[IndexArray, Array]:
    """Columns and numbers of the entries of each row, `[R + more, Z]` each, Z >= 1; filled up with `none` and 0."""
    rows, count = row_index(matrix), np.diff(matrix.indptr)
    place = rows, np.arange(matrix.nnz) - matrix.indptr[rows]
    columns = np.full((matrix.shape[0] + more, count.max(initial=1)), none)
    numbers = np.zeros(columns.shape)
    columns[place], numbers[place] = matrix.indices, matrix.data
    return columns, numbers


def ends_of(lengths: Indices) -> Indices:
    """`[K + 1]` where each of K rows of these lengths begins, end to end, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(lengths)])


def block_rows(places: IndexArray, size: int) -> IndexArray:
    """The rows of blocks of `size` rows each: of the blocks 3 and 1, with two rows, they are 6 7 2 3."""
    return (places[:, None] * size + np.arange(size)).ravel()


def ranks(rows: IndexArray) -> IndexArray:
    """`[E]` the place of each entry in its row, of `rows` `[E]` in order: of 0 0 2 they are 0 1 0."""
    return np.arange(len(rows)) - np.searchsorted(rows, rows)


def distinct(numbers: IndexArray) -> Any:
    """The numbers in order, each once: of 2 0 2 they are 0 2."""
    # Since NumPy 2.3 np.unique hashes integers, which takes ten to a hundred times as long as to sort them.
    ordered = np.sort(numbers)
    return ordered[np.diff(ordered, prepend=ordered[:1] - 1) != 0]


def among(known: IndexArray, wanted: IndexArray) -> tuple[IndexArray, BoolArray]:
    """Where `wanted` numbers are among `known` ones, which are in order, and whether they are; in their shape."""
    # With 37 and 41, 41 is at place 1, and so is 38, another number. The place of 50 would be 2: beyond the last.
    place = np.minimum(np.searchsorted(known, wanted), max(len(known) - 1, 0))
    if not len(known):
        return place, np.zeros(place.shape, np.bool_)
    return place, known[place] == wanted
