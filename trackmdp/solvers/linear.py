"""Linear systems over located cells: expected totals of an episode, V = (I - T)^-1 b (theory.md#exact-value).

A policy starts afresh each time the target is located (a renewal). Any total over an episode (reward, steps,
detections) therefore solves ``v = b + T v``: b is its expectation from one detection to the next, and T(x, j) the
probability that a target located in x is located next in j.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg.blas import daxpy
from scipy.sparse.linalg import spsolve_triangular

from trackmdp.arrays.entries import short_indices
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.errors import UserError
from trackmdp.solvers.factors import ENDLESS, FULL, KEYED_DIRECT, factorised
from trackmdp.solvers.multigrid import Level

DIRECT_CELLS = 20_000
"""Cells up to which systems are factorised. The factors of a grid fill about M^1.4 entries: 75 a cell at M = 16,384."""

# Residual aimed at, relative to the size of right-hand side and solution: some 50 units of rounding of float64.
TOLERANCE = 1e-14
_MOST_PRODUCTS = 20_000


class RenewalSystem:
    """Solves ``v = gathered + transition v`` for any number of `gathered`.

    Up to `direct` cells by a sparse LU factorisation, above by BiCGSTAB preconditioned on coarser and coarser grids
    (`Level`), without which the number of products grows with the length of the episodes: at N = 256 and p_exit = 5e-5
    to 3,434. So it is some 65 at any N, and some 95 at N = 512 where only the border lets the target out.

    Args:
        transition: `[M, M]` sub-stochastic; or `[KM, KM]` of K states per cell, cell j in its k-th state being kM + j.
        size: (rows, columns) of the grid, or `[B]` a group of each of B states that are no cells, at most
            `COARSEST` groups: they take the place of a coarser grid.
        direct: cells of a grid up to which a factorisation is used; of other states it is `KEYED_DIRECT`.
        tolerance: residual at which an iteration ends, relative to the size of right-hand side and solution.

    Attributes:
        exact: whether solutions are exact but for rounding.

    Raises:
        UserError: from some cell the target never exits.
    """

    def __init__(
        self,
        transition: sparse.csr_array,
        size: tuple[int, int] | IndexArray | None = None,
        *,
        direct: int = DIRECT_CELLS,
        tolerance: float = TOLERANCE,
    ) -> None:
        # I - T is an M-matrix with a dominant diagonal: its inverse is non-negative, and no pivoting is needed.
        self._system = short_indices(
            sparse.eye_array(transition.shape[0], format="csr") - transition
        )
        keyed = size is not None and not isinstance(size, tuple)
        self._size, self._tolerance, self._full = size, tolerance, KEYED_DIRECT if keyed else FULL
        self.exact = transition.shape[0] <= (KEYED_DIRECT if keyed else direct)
        if self.exact:
            return
        diagonal = self._system.diagonal()
        self._precondition: Callable[[Array], Array] = (
            (lambda right: right / diagonal) if size is None else Level(self._system, size)
        )

    def solve(
        self, gathered: Array, guess: Array | None = None, *, transposed: bool = False
    ) -> Array:
        """`[M]` or `[M, K]`, as `gathered` is.

        Args:
            gathered: right-hand sides.
            guess: of the same shape, where an iteration starts.
            transposed: solve ``v = gathered + transition^T v`` instead.

        Raises:
            UserError: from some cell the target never exits.
        """
        wanted = np.asarray(gathered, np.float64)
        if self.exact:
            total = self._solve(wanted, transposed)
        elif transposed:
            return self._turned.solve(gathered, guess)
        else:
            # One right-hand side after the other: together they would share nothing but the reading of the matrix, and
            # need K times the memory.
            starts = np.zeros_like(wanted) if guess is None else guess
            pairs = zip(
                wanted.reshape(len(wanted), -1).T, starts.reshape(len(wanted), -1).T, strict=True
            )
            total = np.stack([self._iterate(*pair) for pair in pairs], axis=-1).reshape(
                wanted.shape
            )
        # A singular system may be factorised all the same, and then gives inf or nan in place of an error.
        if not np.isfinite(total).all():
            raise UserError(ENDLESS)
        return total

    @cached_property
    def _solve(self) -> Callable[[Array, bool], Array]:
        return factorised(self._system, self._full if self.exact else self._system.shape[0])

    def changed(self, other: RenewalSystem, states: IndexArray) -> Array:
        """`[m, m]` (T' - T)(I - T)^-1 between those `states` `[m]` in which the T' of another system differs from T.

        With some C of them as in T' and the others as in T, the visits v of C are v (I - this)^-1, both for C alone
        (Woodbury 1950). By a factorisation of the full matrix, also where single solutions are iterated.
        """
        units = np.zeros((self._system.shape[0], len(states)), order="F")
        units[states, np.arange(len(states))] = 1.0
        change: Array = (self._system[states] - other._system[states]) @ self._solve(units, False)
        return change

    @cached_property
    def _turned(self) -> RenewalSystem:
        """The system of the transposed matrix, for iteration."""
        other = copy.copy(self)
        other._system = sparse.csr_array(self._system.T)
        if self._size is not None:
            other._precondition = Level(other._system, self._size)
        return other

    def residual(self, gathered: Array, solution: Array) -> Array:
        """`[M]` or `[M, K]`, gathered - (I - transition) solution."""
        return gathered - self._system @ solution

    def passed_on(self, mass: Array) -> Array:
        """`[M]`, mass transition: where mass in the states is after one transition."""
        return mass - mass @ self._system

    def error(self, gathered: Array, solution: Array, longest: float) -> float:
        """No entry of a `solution` is farther from the exact one; 0 where the system was factorised.

        With e = v - v̂ = (I - T)^-1 (residual of v̂) and (I - T)^-1 >= 0, with row sums of at most the expected number
        of renewals, |e| <= longest · max |residual|; an episode has no more renewals than its steps, which `longest`
        bounds.
        """
        if self.exact:
            return 0.0
        return longest * float(np.abs(self.residual(gathered, solution)).max())

    def _iterate(self, gathered: Array, start: Array) -> Array:
        """BiCGSTAB, started anew while that makes the true residual (the recursive one drifts off) much smaller."""
        gathered, best, products = np.ascontiguousarray(gathered), np.array(start), 0
        residual = self.residual(gathered, best)
        # Rounding alone leaves a residual of about 1e-16 times the solution; nothing is gained below the target.
        while True:
            target = self._tolerance * float(np.abs(gathered).max() + np.abs(best).max())
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
            # numpy's pairwise sum, the same bits for any number of BLAS threads
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


def accumulate(
    transition: sparse.csr_array, gathered: Array, size: tuple[int, int] | None = None
) -> Array:
    """Solve ``v = gathered + transition v`` once; see `RenewalSystem`."""
    return RenewalSystem(transition, size).solve(gathered)


def solve_onward(
    level: IndexArray, transition: sparse.csr_array, gathered: Array, *, transposed: bool = False
) -> Array:
    """Solves ``v = gathered + transition v`` where each event leads to events of higher levels alone.

    Args:
        level: `[B]`, of each event.
        transition: `[B, B]`.
        gathered: `[B]` or `[B, K]`, as the result is.
        transposed: solve ``v = gathered + transition^T v`` instead.
    """
    order = np.argsort(level, kind="stable")
    system = sparse.eye_array(len(order), format="csr") - transition[order][:, order]
    found = np.empty_like(gathered)
    found[order] = spsolve_triangular(
        system.T if transposed else system, gathered[order], lower=transposed, unit_diagonal=True
    )
    return found


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else 0.0
