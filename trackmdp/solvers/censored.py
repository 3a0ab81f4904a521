"""Paths with misses, which are censored moves: what happened on them, in expectation, given a kernel."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.solvers.renewal import IndexArray, row_index
from trackmdp.world.model import Array


@dataclass(frozen=True)
class ObservedPaths:
    """K observed paths from one detection to the next.

    Attributes:
        start: `[K]`, located cell.
        misses: `[K]`, n, how often the target was missed on the way.
        sensed: `[K * (t_max + 1), M]` sparse bool; row `k * (t_max + 1) + t` is the set of the miss t of path k. Rows
            of t >= n are not read.
        end: `[K]`, where it was located next; M once it had exited; M + 1 where all that is known is that the last
            miss left it in the grid.
    """

    start: IndexArray
    misses: IndexArray
    sensed: sparse.csr_array
    end: IndexArray

    @property
    def choices(self) -> int:
        """t_max + 1."""
        return int(self.sensed.shape[0] // max(len(self.start), 1))

    def pick(self, paths: IndexArray) -> ObservedPaths:
        """The `paths` of these numbers, in their order."""
        # With t_max = 1, path 3 has the rows 3 * 2 + (0, 1) = 6, 7.
        rows = (paths[:, None] * self.choices + np.arange(self.choices)).ravel()
        return ObservedPaths(self.start[paths], self.misses[paths], self.sensed[rows], self.end[paths])

    @classmethod
    def of(cls, parts: Sequence[ObservedPaths], cells: int) -> ObservedPaths:
        """All paths of `parts`, one after the other, on a grid of so many cells."""
        none = np.zeros(0, dtype=np.int64)
        each = [cls(none, none, sparse.csr_array((0, cells), dtype=bool), none), *parts]
        start, misses, end = (
            np.concatenate([getattr(part, name) for part in each]) for name in ("start", "misses", "end")
        )
        return cls(start, misses, sparse.csr_array(sparse.vstack([part.sensed for part in each])), end)


def each_once(paths: ObservedPaths) -> tuple[ObservedPaths, Array]:
    """Equal paths once, and how often each occurs.

    Sets are told apart by two sums of 64 random bits per (miss, cell): unequal ones agree with probability 2^-128.
    """
    choices, m = paths.choices, paths.sensed.shape[1]
    # Row k * (t_max + 1) + t belongs to miss t of path k; rows of t >= n were never used, and must not tell paths
    # apart.
    path, miss = np.divmod(row_index(paths.sensed), choices)
    read = miss < paths.misses[path]
    marks = np.random.default_rng(0).integers(2**63, size=(2, choices * m), dtype=np.uint64)
    # path k's sum is over its own entries, in any order: equal sets have equal sums
    sums = np.zeros((2, len(paths.start)), dtype=np.uint64)
    for mark, total in zip(marks, sums, strict=True):  # unsigned sums wrap around, which is what is wanted
        np.add.at(total, path[read], mark[(miss * m + paths.sensed.indices)[read]])
    keys = np.stack([*(part.astype(np.uint64) for part in (paths.start, paths.misses, paths.end)), *sums], axis=1)
    _, first, copies = np.unique(keys, axis=0, return_index=True, return_counts=True)
    return paths.pick(first), copies.astype(np.float64)


def expected_moves(
    kernel: sparse.csr_array, paths: ObservedPaths, copies: Array, detection: Array | None
) -> sparse.csr_array:
    """`[M, M + 1]` expected moves on the censored paths, given the kernel and p_d.

    With f_t the mass that goes on undetected and l_t the likelihood of what is seen later, the move i -> j at step t of
    a path is made with probability f_t(i) P_ij l_{t+1}(j) / (likelihood of the path); P_ij is multiplied in at the end.
    """
    m = kernel.shape[0]
    moves, backward = sparse.csr_array(kernel[:, :-1]), sparse.csr_array(kernel.T)
    expected = sparse.csr_array(kernel.shape)
    told = paths.end <= m
    for n, ends in itertools.product(np.unique(paths.misses), (True, False)):
        part = np.flatnonzero((paths.misses == n) & (told == ends))
        if not len(part):
            continue
        some, each = paths.pick(part), np.arange(len(part))
        # Rows t, t + (t_max + 1), ...: the set of miss t of every path, [paths, M].
        sensed = [some.sensed[t :: some.choices].astype(np.float64) for t in range(n)]
        if detection is not None:  # a miss is as likely in a sensed cell as its sensor misses
            sensed = [sparse.csr_array(each_set.multiply(detection)) for each_set in sensed]
        forward = [counted(each, some.start, np.ones(len(part)), (len(part), m))]
        for t in range(n):
            forward.append(_hidden(forward[t] @ moves, sensed[t]))
        # row `end` of P^T is the likelihood of ending there, by the cell before; 1 wherever it may be if no end is told
        later = backward[some.end] if ends else (forward[n] > 0).astype(np.float64)
        weight = copies[part] / np.maximum(forward[n].multiply(later).sum(axis=1), 1e-300)
        if ends:
            # The last move ends in the known cell, or in the exit, column M: f_n(i) at (i, end), weighted.
            expected = expected + forward[n].T @ counted(each, some.end, weight, (len(part), m + 1))
        for t in range(n - 1, -1, -1):
            later = _hidden(later, sensed[t])
            moved = sparse.csr_array(forward[t].T @ (sparse.diags_array(weight) @ later))
            expected = expected + sparse.hstack([moved, sparse.csr_array((m, 1))], format="csr")
            # l_t(i) = sum_j P_ij l_{t+1}(j), with l zero where the cell was sensed: there it would have been detected.
            later = later @ moves.T
    return sparse.csr_array(sparse.csr_array(expected).multiply(kernel))


def _hidden(mass: sparse.csr_array, sensed: sparse.csr_array) -> sparse.csr_array:
    """`mass` less what the sensors report of it: `sensed` holds their p_d."""
    left = sparse.csr_array(mass - mass.multiply(sensed))
    left.eliminate_zeros()
    return left


def counted(start: IndexArray, end: IndexArray, weight: Array, shape: tuple[int, int]) -> sparse.csr_array:
    """Sums of `weight` over equal (start, end)."""
    return sparse.csr_array((weight, (start, end)), shape=shape)
