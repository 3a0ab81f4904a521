"""A preconditioner on coarser and coarser grids, for systems too large to be factorised."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import short_indices, summing
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.solvers.factors import FULL, KEYED_DIRECT, factorised

# Side of the square blocks that are one cell of the next coarser level, and cells at which a level is factorised.
_BLOCK = 4
COARSEST = 4_096


class Level:
    """Approximate inverse of a system on a grid: here the differences of neighbours, one level down the smooth part.

    Two damped Jacobi sweeps reduce the differences between neighbours; between them comes a correction, constant on
    blocks of 4 x 4 cells: the next level's approximate solution. That level costs a sixteenth, so it is applied twice;
    the number of products hardly grows with the grid and equals the number with the exact solution of that level.

    Args:
        system: `[KM, KM]`, K states a cell; cell j in its k-th state is kM + j.
        size: (rows, columns) of the grid; or the group of each state.
    """

    def __init__(self, system: sparse.csr_array, size: tuple[int, int] | IndexArray) -> None:
        self._system = system
        # 0.8 is the usual damping of Jacobi as a smoother.
        self._damping = 0.8 / system.diagonal()
        if isinstance(size, tuple):
            # States beyond one per cell are that many layers of the grid, each with blocks of its own.
            layers = system.shape[0] // (size[0] * size[1])
            self._blocks = sparse.csr_array(sparse.block_diag([_blocks(*size)] * layers))
        else:
            self._blocks = summing(size, size.max() + 1).T.tocsr()
        self._sums = self._blocks.T
        # Galerkin: with B [M, blocks] the indicator of the blocks, B^T A B is the system seen by vectors that are
        # constant on each block.
        coarse = short_indices(sparse.csr_array(self._sums @ system @ self._blocks))
        if coarse.shape[0] <= COARSEST or not isinstance(size, tuple):
            solve = factorised(coarse, FULL if isinstance(size, tuple) else KEYED_DIRECT)
            self._corrected: Callable[[Array], Array] = lambda left: solve(left, False)
            return
        below = Level(coarse, (-(-size[0] // _BLOCK), -(-size[1] // _BLOCK)))

        def twice(left: Array) -> Array:
            guess = below(left)
            return guess + below(left - coarse @ guess)

        self._corrected = twice

    def __call__(self, residual: Array) -> Array:
        """`[KM]`, about the solution of system x = `residual`."""
        guess: Array = self._damping * residual
        left = residual - self._system @ guess
        guess += self._blocks @ self._corrected(self._sums @ left)
        left = residual - self._system @ guess
        left *= self._damping
        guess += left
        return guess


def _blocks(rows: int, columns: int) -> sparse.csr_array:
    """`[M, blocks]` which block of the grid each cell lies in.

    With blocks of 4 x 4, the cell in row 9 and column 20 of a grid of 256 columns (64 blocks a row of blocks) lies in
    block 2 · 64 + 5 = 133.
    """
    # -(-a // b) is a / b rounded up: the last blocks of a row or column may be cut off by the border.
    row, column = np.divmod(np.arange(rows * columns), columns)
    block = row // _BLOCK * -(-columns // _BLOCK) + column // _BLOCK
    return summing(block, block[-1] + 1).T.tocsr()
