"""Linear systems over located cells: what is gathered until the target exits.

A policy starts afresh each time the target is located (a renewal), so everything it gathers over an episode solves
``v = b + T v`` with b what one renewal gathers and T where the target is located next.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

from trackmdp.errors import UserError
from trackmdp.world.model import Array, World

__all__ = ["IndexArray", "accumulate", "expected_steps", "per_row", "row_index", "row_sums"]

IndexArray: TypeAlias = npt.NDArray[np.integer[Any]]

LONGEST_EPISODE = 1e12
_ENDLESS = (
    "kernel: from some cell the target never exits, so no value is finite: expected an exit reachable from each cell"
)


def accumulate(transition: sparse.csr_array, gathered: Array) -> Array:
    """Solve ``v = gathered + transition v``.

    Args:
        transition: `[M, M]` sub-stochastic.
        gathered: `[M]` or `[M, K]`, what one pass from each cell gathers.

    Raises:
        UserError: if from some cell the target never exits.
    """
    system = sparse.csc_array(sparse.eye_array(transition.shape[0]) - transition)
    try:
        total: Array = splu(system).solve(np.asarray(gathered, dtype=np.float64))
    except RuntimeError as error:  # SuperLU: the matrix is exactly singular
        raise UserError(_ENDLESS) from error
    if not np.isfinite(total).all():
        raise UserError(_ENDLESS)
    return total


def expected_steps(world: World) -> Array:
    """`[M]` expected steps until the exit, the exit step included; sensing never changes it."""
    steps = accumulate(world.kernel, np.ones(world.num_cells))
    if (steps < 0).any() or (steps > LONGEST_EPISODE).any():
        raise UserError(_ENDLESS)
    return steps


def row_sums(matrix: sparse.csr_array) -> Array:
    """`[B]` sums over the entries of each row."""
    return per_row(row_index(matrix), matrix.data, matrix.shape[0])


def per_row(rows: IndexArray, values: Array, count: int) -> Array:
    """`[count]` sums of `values` over equal `rows`."""
    return np.bincount(rows, weights=values, minlength=count).astype(np.float64, copy=False)


def row_index(matrix: sparse.csr_array) -> IndexArray:
    """`[nnz]` the row of each stored entry."""
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
