"""Linear systems over located cells: expected totals of an episode, V = (I - T)^-1 b (theory: exact evaluation).

A policy starts afresh each time the target is located (a renewal). Any total over an episode (reward, steps,
detections) therefore solves ``v = b + T v``: b is its expectation from one detection to the next, and T(x, j) the
probability that a target located in x is located next in j.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg.blas import daxpy
from scipy.linalg.lapack import dgetrf, dgetrs
from scipy.sparse.linalg import splu

from trackmdp.errors import UserError
from trackmdp.world.checks import short_indices
from trackmdp.world.model import Array, World

IndexArray: TypeAlias = npt.NDArray[np.integer[Any]]

DIRECT_CELLS = 20_000
"""Cells up to which systems are factorised. The factors of a grid fill about M^1.4 entries: 75 a cell at M = 16,384."""

# Cells up to which a full matrix is factorised, in a quarter of the time: beliefs that spread leave few zeros.
_FULL = 200
# Side of the square blocks that are one cell of the next coarser level, and cells at which a level is factorised.
_BLOCK = 4
_COARSEST = 4_096
# Residual aimed at, relative to the size of right-hand side and solution: some 50 units of rounding of float64.
_TOLERANCE = 1e-14
_MOST_PRODUCTS = 20_000
# Where some cells have no way out, I - P is singular; if rounding lets the solve pass, lengths come out negative or
# about 1 / 1e-16. No kernel that is meant to end comes near 1e12 steps.
_LONGEST_EPISODE = 1e12
_ENDLESS = (
    "kernel: from some cell the target never exits, so no value is finite: expected an exit reachable from each cell"
)


class RenewalSystem:
    """Solves ``v = gathered + transition v`` for any number of `gathered`.

    Up to `direct` cells by a sparse LU factorisation, above by BiCGSTAB preconditioned on coarser and coarser grids
    (`_Level`), without which the number of products grows with the length of the episodes: at N = 256 and p_exit = 5e-5
    to 3,434. So it is some 65 at any N, and some 95 at N = 512 where only the border lets the target out.

    Args:
        transition: `[M, M]` sub-stochastic; or `[KM, KM]` of K states per cell, cell j in its k-th state being kM + j.
        size: (rows, columns) of the grid; None where the states are no cells, and there is no coarser grid.
        direct: cells up to which a factorisation is used.

    Attributes:
        exact: whether solutions are exact but for rounding.

    Raises:
        UserError: from some cell the target never exits.
    """

    def __init__(
        self, transition: sparse.csr_array, size: tuple[int, int] | None = None, *, direct: int = DIRECT_CELLS
    ) -> None:
        # I - T is an M-matrix with a dominant diagonal: its inverse is non-negative, and no pivoting is needed.
        self._system = short_indices(sparse.csr_array(sparse.eye_array(transition.shape[0], format="csr") - transition))
        self.exact = transition.shape[0] <= direct
        if self.exact:
            self._solve = _factorised(self._system)
            return
        # The inverse of the diagonal, 40 products, where states are pairs of many classes that share their cells.
        diagonal = self._system.diagonal()
        self._precondition: Callable[[Array], Array]
        self._precondition = (lambda right: right / diagonal) if size is None else _Level(self._system, size)

    def solve(self, gathered: Array, guess: Array | None = None) -> Array:
        """`[M]` or `[M, K]`, as `gathered` is; `guess`, of the same shape, is where an iteration starts.

        Raises:
            UserError: from some cell the target never exits.
        """
        wanted = np.asarray(gathered, dtype=np.float64)
        if self.exact:
            total = self._solve(wanted)
        else:
            # One right-hand side after the other: together they would share nothing but the reading of the matrix, and
            # need K times the memory.
            starts = np.zeros_like(wanted) if guess is None else guess
            pairs = zip(wanted.reshape(len(wanted), -1).T, starts.reshape(len(wanted), -1).T, strict=True)
            total = np.stack([self._iterate(*pair) for pair in pairs], axis=-1).reshape(wanted.shape)
        # A singular system may be factorised all the same, and then gives inf or nan in place of an error.
        if not np.isfinite(total).all():
            raise UserError(_ENDLESS)
        return total

    def residual(self, gathered: Array, solution: Array) -> Array:
        """`[M]` or `[M, K]`, gathered - (I - transition) solution."""
        return gathered - self._system @ solution

    def upper(self, gathered: Array, longest: float) -> Array:
        """`[M]` no less than the solution, whatever the iteration left; `longest` bounds the steps of an episode.

        With e = v - v̂ = (I - T)^-1 (residual of v̂) and (I - T)^-1 >= 0, whose rows sum to at most the expected
        number of renewals, |e| <= longest · max |residual|.
        """
        solution = self.solve(gathered)
        return solution if self.exact else solution + longest * float(np.abs(self.residual(gathered, solution)).max())

    def _iterate(self, gathered: Array, start: Array) -> Array:
        """BiCGSTAB, started anew while that makes the true residual (the recursive one drifts off) much smaller."""
        gathered, best, products = np.ascontiguousarray(gathered), np.array(start), 0
        residual = self.residual(gathered, best)
        # Rounding alone leaves a residual of about 1e-16 times the solution; nothing is gained below the target.
        while True:
            target = _TOLERANCE * float(np.abs(gathered).max() + np.abs(best).max())
            if np.abs(residual).max() <= target or products > _MOST_PRODUCTS:
                return best
            candidate, spent = self._bicgstab(best, residual, target)
            products += spent
            after = self.residual(gathered, candidate)
            if not np.abs(after).max() < 0.5 * np.abs(residual).max():  # rounding is reached
                return best if np.abs(residual).max() < np.abs(after).max() else candidate
            best, residual = candidate, after

    def _bicgstab(self, start: Array, residual: Array, target: float) -> tuple[Array, int]:
        """Van der Vorst's method, right-preconditioned; `[M]` vectors, changed in place to spare memory."""
        # The names of van der Vorst (1992): shadow r^, direction p, image A M^-1 p, moved t = A M^-1 s.
        shadow, residual, solution, products = residual, residual.copy(), start.copy(), 0
        direction, image, spare = (np.zeros_like(residual) for _ in range(3))
        rho = alpha = omega = 1.0

        def dot(one: Array, other: Array) -> float:
            # numpy's pairwise sum, the same bits whatever the number of BLAS threads
            return float(np.multiply(one, other, out=spare).sum())

        while products < _MOST_PRODUCTS and np.abs(residual, out=spare).max() > target:
            correlation = dot(shadow, residual)
            if correlation == 0 or omega == 0:  # broken down: the caller starts anew from here
                break
            # daxpy(x, y, a): y += a x in place. direction = residual + beta (direction - omega image)
            daxpy(image, direction, a=-omega)
            direction *= correlation * alpha / (rho * omega)
            direction += residual
            ahead = self._precondition(direction)
            image = self._system @ ahead
            rho, alpha = correlation, _ratio(correlation, dot(shadow, image))
            daxpy(image, residual, a=-alpha)
            correction = self._precondition(residual)
            moved = self._system @ correction
            omega = _ratio(dot(moved, residual), dot(moved, moved))
            daxpy(ahead, solution, a=alpha)
            daxpy(correction, solution, a=omega)
            daxpy(moved, residual, a=-omega)
            products += 2
        return solution, products


class _Level:
    """An approximate inverse of a system on a grid: what differs from cell to cell here, what is smooth one level down.

    Two damped Jacobi sweeps take out what differs from cell to cell; between them comes a correction that is constant
    on blocks of 4 x 4 cells, the next level's approximate solution. That level costs a sixteenth, so that it is asked
    twice, and the number of products hardly grows with the grid: with its exact solution it is the same.

    Args:
        system: `[KM, KM]`, K states a cell; cell j in its k-th state is kM + j.
        size: (rows, columns) of the grid.
    """

    def __init__(self, system: sparse.csr_array, size: tuple[int, int]) -> None:
        self._system = system
        # 0.8 is the usual damping of Jacobi as a smoother.
        self._damping = 0.8 / system.diagonal()
        # States beyond one per cell are that many layers of the grid, each with blocks of its own.
        layers = system.shape[0] // (size[0] * size[1])
        self._blocks = sparse.csr_array(sparse.block_diag([_blocks(*size)] * layers))
        # Galerkin: with B [M, blocks] the indicator of the blocks, B^T A B is the system seen by vectors that are
        # constant on each block.
        coarse = short_indices(sparse.csr_array(self._blocks.T @ system @ self._blocks))
        small = coarse.shape[0] <= _COARSEST
        self._below = None if small else _Level(coarse, (-(-size[0] // _BLOCK), -(-size[1] // _BLOCK)))
        self._solve = _factorised(coarse) if small else None

    def __call__(self, residual: Array) -> Array:
        """`[KM]`, about the solution of system x = `residual`."""
        guess: Array = self._damping * residual
        left = residual - self._system @ guess
        guess += self._blocks @ self._corrected(self._blocks.T @ left)
        left = residual - self._system @ guess
        left *= self._damping
        guess += left
        return guess

    def _corrected(self, residual: Array) -> Array:
        """The solution on the blocks."""
        if self._below is None:
            assert self._solve is not None
            return self._solve(residual)
        guess = self._below(residual)
        return guess + self._below(residual - self._below._system @ guess)


def accumulate(transition: sparse.csr_array, gathered: Array, size: tuple[int, int] | None = None) -> Array:
    """Solve ``v = gathered + transition v`` once; see `RenewalSystem`."""
    return RenewalSystem(transition, size).solve(gathered)


def forced_worth(world: World, detected: Array) -> Array:
    """`[M]` worth of the target being in each cell when the safe action is next, repeated until it locates the target.

    L = P [p_s (r + V) + (1 - p_s) L] - D p_in, `detected` `[M]` being r + V: another linear system, of matrix
    P (1 - p_s), which without misses is empty.
    """
    if world.safe:
        return world.kernel @ (detected - world.safe_cost)
    located = world.kernel @ (world.safe_detection * detected) - world.safe_cost * world.stay_probability
    return _safe_system(world).solve(located)


@lru_cache(maxsize=1)
def _safe_system(world: World) -> RenewalSystem:
    """The moves on which the safe action misses the target."""
    return RenewalSystem(sparse.csr_array(world.kernel.multiply(1.0 - world.safe_detection)), world.size)


@lru_cache(maxsize=1)
def expected_steps(world: World) -> Array:
    """`[M]` expected steps until the exit, the exit step included; sensing never changes it.

    Raises:
        UserError: from some cell the target never exits.
    """
    # L = 1 + P L: every step counts once, whatever is sensed, so that P stands in place of T.
    steps = accumulate(world.kernel, np.ones(world.num_cells), world.size)
    check_length(steps)
    return steps


def check_length(steps: Array) -> None:
    """Refuse expected steps that no kernel with an exit from each cell can have."""
    if (steps < 0).any() or (steps > _LONGEST_EPISODE).any():
        raise UserError(_ENDLESS)


def per_row(rows: IndexArray, values: Array, count: int) -> Array:
    """`[count]` sums of `values` over equal `rows`."""
    return np.bincount(rows, weights=values, minlength=count).astype(np.float64, copy=False)


def row_index(matrix: sparse.csr_array) -> IndexArray:
    """`[nnz]` the row of each stored entry."""
    # indptr = (0, 2, 2, 5) has rows of 2, 0 and 3 entries: 0 0 2 2 2. int64, so that row · M + cell never overflows.
    return np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))


def _factorised(system: sparse.csr_array) -> Callable[[Array], Array]:
    """Solves with I - T by its LU factors.

    Raises:
        UserError: the matrix is exactly singular.
    """
    if system.shape[0] <= _FULL:
        factors, pivots, singular = dgetrf(system.toarray(order="F"), overwrite_a=True)
        if singular:
            raise UserError(_ENDLESS)
        return lambda wanted: dgetrs(factors, pivots, wanted)[0]
    try:
        # Without pivoting, which a matrix with dominant diagonal does not need: that keeps the fill low.
        solve: Callable[[Array], Array] = splu(
            sparse.csc_array(system), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        ).solve
    except RuntimeError as error:  # SuperLU: the matrix is exactly singular
        raise UserError(_ENDLESS) from error
    return solve


def _blocks(rows: int, columns: int) -> sparse.csr_array:
    """`[M, blocks]` which block of the grid each cell lies in.

    With blocks of 4 x 4, the cell in row 9 and column 20 of a grid of 256 columns (64 blocks a row of blocks) lies in
    block 2 · 64 + 5 = 133.
    """
    # -(-a // b) is a / b rounded up: the last blocks of a row or column may be cut off by the border.
    row, column = np.divmod(np.arange(rows * columns), columns)
    block = row // _BLOCK * -(-columns // _BLOCK) + column // _BLOCK
    return sparse.csr_array((np.ones(len(block)), (np.arange(len(block)), block)))


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else 0.0
