"""LU factors of a system I - T, as a full matrix or a sparse one."""

from __future__ import annotations

from collections.abc import Callable

from scipy import sparse
from scipy.linalg.lapack import dgetrf, dgetrs
from scipy.sparse.linalg import splu

from trackmdp.arrays.types import Array
from trackmdp.errors import UserError

# Cells up to which a full matrix is factorised, in a quarter of the time: beliefs that spread leave few zeros.
FULL = 200
KEYED_DIRECT = 700
"""Events of several keys or modes a cell up to which their system, or one of groups of them, is factorised as a full
matrix: each leads to all cells in reach."""
ENDLESS = (
    "kernel: from some cell the target never exits, so no value is finite: "
    "expected an exit reachable from each cell"
)


def factorised(system: sparse.csr_array, full: int = FULL) -> Callable[[Array, bool], Array]:
    """Solves with I - T, or with its transpose, by its LU factors.

    Raises:
        UserError: the matrix is exactly singular.
    """
    if system.shape[0] <= full:
        # Transposed, each column is dominated by its diagonal, so that no rows are exchanged: a huge price in states
        # that are not reached would leave its rounding in the others.
        factors, pivots, singular = dgetrf(system.toarray().T, overwrite_a=True)
        if singular:
            raise UserError(ENDLESS)
        return lambda wanted, transposed: dgetrs(factors, pivots, wanted, trans=not transposed)[0]
    try:
        # Without pivoting, which a matrix with dominant diagonal does not need: that keeps the fill low.
        factors = splu(
            sparse.csc_array(system),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:  # SuperLU: the matrix is exactly singular
        raise UserError(ENDLESS) from error
    return lambda wanted, transposed: factors.solve(wanted, "T" if transposed else "N")
