"""The target's kernel estimated from what a tracker sees: detections, exits, and misses, which are censored moves.

A miss tells that the target is among the cells not sensed, and no more. Expectation-maximisation shares each such
path among the moves it may have been (a forward and a backward pass), so that chosen sets give consistent estimates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.solvers.renewal import IndexArray
from trackmdp.world.model import Array, BoolArray

__all__ = ["KernelEstimate", "Paths"]


OPEN = 0.01
"""Share of the first round's kernel that allows moves not seen yet."""
NEGLIGIBLE = 1e-3
"""Expected number of moves that is none."""
_PARTS = ("start", "misses", "sensed", "end")


@dataclass(frozen=True)
class Paths:
    """K observed paths from one detection to the next.

    Attributes:
        start: `[K]`, located cell.
        misses: `[K]`, n, how often the target was missed on the way.
        sensed: `[K, t_max + 1, M]`, the sets of those misses; slots n and later are not read.
        end: `[K]`, where it was located next; M once it had exited.
    """

    start: IndexArray
    misses: IndexArray
    sensed: BoolArray
    end: IndexArray


class KernelEstimate:
    """Posterior of the kernel, row by row: Dirichlet over the next cell, Beta for the exit.

    The prior of a row is the target's mean behaviour, all rows pooled: the displacements seen so far, as far as they
    stay in the grid, and the pooled exit probability.

    Args:
        size: N.
        weight: the prior counts as much as this many moves.
        exit_weight: the pooled exit probability counts as much as this many moves.
    """

    def __init__(self, size: int, *, weight: float, exit_weight: float) -> None:
        self.size, self.weight, self.exit_weight = size, weight, exit_weight
        m = size**2
        self.direct = np.zeros((m, m + 1))
        self.counts = self.direct
        self._censored: list[Paths] = []

    def add(self, paths: Paths) -> None:
        """Take note of `paths`."""
        at_once = paths.misses == 0
        np.add.at(self.direct, (paths.start[at_once], paths.end[at_once]), 1.0)
        rest = ~at_once
        if rest.any():
            self._censored.append(Paths(paths.start[rest], paths.misses[rest], paths.sensed[rest], paths.end[rest]))

    def state(self) -> dict[str, np.ndarray]:
        """All that was observed, and the counts so far."""
        parts = self._censored or [_no_paths(self.size**2)]
        merged = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _PARTS}
        return {"direct": self.direct, "counts": self.counts, **merged}

    def load_state(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state`."""
        self.direct, self.counts = state["direct"].copy(), state["counts"].copy()
        self._censored = [Paths(*(state[name].copy() for name in _PARTS))] if len(state["start"]) else []

    def fit(self, rounds: int) -> None:
        """Share the censored paths among the moves, `rounds` times, each time by the kernel found before.

        The first round allows every move a little farther than any that must have been made: expectation-maximisation
        never leaves a probability of zero.
        """
        if not self._censored:
            self.counts = self.direct.copy()
            return
        paths, copies = _merge(self._censored)
        for first in [True, *[False] * (rounds - 1)]:
            kernel = (1.0 - OPEN) * self.mean() + OPEN * self._open_moves(paths) if first else self.mean()
            self.counts = self.direct + _expected_moves(kernel, paths, copies)
        self.counts[self.counts < NEGLIGIBLE] = 0.0

    def mean(self) -> Array:
        """`[M, M + 1]` posterior mean; the last column is the exit."""
        moves, exits = self._parameters()
        stay = moves / moves.sum(axis=1, keepdims=True)
        leave = exits[:, :1] / exits.sum(axis=1, keepdims=True)
        return np.hstack([stay * (1.0 - leave), leave])

    def sample(self, rng: np.random.Generator) -> Array:
        """`[M, M + 1]` one kernel drawn from the posterior, censored paths taken at their expected moves."""
        moves, exits = self._parameters()
        weights = np.zeros_like(moves)
        weights[moves > 0] = rng.standard_gamma(moves[moves > 0]) + 1e-300
        leave = rng.beta(exits[:, :1], exits[:, 1:])
        return np.hstack([weights / weights.sum(axis=1, keepdims=True) * (1.0 - leave), leave])

    @property
    def visits(self) -> Array:
        """`[M]` moves seen out of each cell, censored ones at their expectation."""
        visits: Array = self.counts.sum(axis=1)
        return visits

    def _parameters(self) -> tuple[Array, Array]:
        """Dirichlet parameters `[M, M]` of the moves and Beta parameters `[M, 2]` of the exit."""
        moved, left = self.counts[:, :-1], self.counts[:, -1]
        pooled = (left.sum() + 0.5) / (self.counts.sum() + 1.0)
        exits = np.stack([left + self.exit_weight * pooled, moved.sum(axis=1) + self.exit_weight * (1 - pooled)], 1)
        return moved + self.weight * self._typical_moves(moved), exits

    def _open_moves(self, paths: Paths) -> Array:
        """`[M, M + 1]` uniform over the cells that one move may reach, judging by the fastest path seen."""
        n, cells = self.size, np.arange(self.size**2)
        away = np.maximum(np.abs(cells[:, None] // n - cells // n), np.abs(cells[:, None] % n - cells % n))
        inside = paths.end < len(cells)
        gone = away[paths.start[inside], paths.end[inside]]
        reach = max(
            np.ceil(gone / (paths.misses[inside] + 1)).max(initial=1), away[self.direct[:, :-1] > 0].max(initial=1)
        )
        near = away <= reach + 1
        return np.hstack([near / near.sum(axis=1, keepdims=True), np.zeros((len(cells), 1))])

    def _typical_moves(self, moved: Array) -> Array:
        """`[M, M]` pooled displacements, put down at every cell, scaled to 1; uniform while nothing was seen."""
        m, n = self.size**2, self.size
        start, end = np.nonzero(moved > 1e-9)
        if not len(start):
            return np.full((m, m), 1.0 / m)
        share = moved[start, end] / moved.sum(axis=1)[start]
        shift = (end // n - start // n + n) * 2 * n + (end % n - start % n + n)
        shifts, place = np.unique(shift, return_inverse=True)
        weight = np.bincount(place, weights=share)
        rows, columns = shifts // (2 * n) - n, shifts % (2 * n) - n
        cells = np.arange(m)
        row, column = cells[:, None] // n + rows, cells[:, None] % n + columns
        inside = (row >= 0) & (row < n) & (column >= 0) & (column < n)
        typical = np.zeros((m, m))
        origin, which = np.nonzero(inside)
        typical[origin, (row * n + column)[inside]] = weight[which]
        total = typical.sum(axis=1, keepdims=True)
        return np.where(total > 0, typical / np.maximum(total, 1e-300), 1.0 / m)


def _no_paths(cells: int) -> Paths:
    none = np.zeros(0, dtype=np.int64)
    return Paths(none, none, np.zeros((0, 1, cells), dtype=bool), none)


def _merge(parts: list[Paths]) -> tuple[Paths, Array]:
    """All paths, equal ones once, and how often each occurs."""
    start = np.concatenate([part.start for part in parts])
    misses = np.concatenate([part.misses for part in parts])
    end = np.concatenate([part.end for part in parts])
    sensed = np.concatenate([part.sensed for part in parts])
    sensed &= np.arange(sensed.shape[1])[:, None] < misses[:, None, None]
    bits = np.packbits(sensed.reshape(len(start), -1), axis=1)
    keys = np.hstack([np.stack([start, misses, end], axis=1).astype(np.int64).view(np.uint8), bits])
    _, first, copies = np.unique(keys, axis=0, return_index=True, return_counts=True)
    return Paths(start[first], misses[first], sensed[first], end[first]), copies.astype(np.float64)


def _expected_moves(kernel: Array, paths: Paths, copies: Array) -> Array:
    """`[M, M + 1]` expected moves on the censored paths, given the kernel."""
    m = len(kernel)
    moves, counts = sparse.csr_array(kernel[:, :-1]), np.zeros_like(kernel)
    for n in np.unique(paths.misses):
        rows = np.flatnonzero(paths.misses == n)
        hidden = ~paths.sensed[rows, :n]
        forward = [np.eye(m)[paths.start[rows]]]
        for t in range(n):
            forward.append((forward[t] @ moves) * hidden[:, t])
        later = kernel[:, paths.end[rows]].T
        weight = copies[rows] / np.maximum((forward[n] * later).sum(axis=1), 1e-300)
        arrivals = sparse.csr_array((weight, (np.arange(len(rows)), paths.end[rows])), shape=(len(rows), m + 1))
        counts += (arrivals.T @ forward[n]).T
        for t in range(n - 1, -1, -1):
            later = later * hidden[:, t]
            counts[:, :-1] += (forward[t] * weight[:, None]).T @ later
            later = later @ moves.T
    return counts * kernel
