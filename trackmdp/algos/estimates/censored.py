"""Paths with misses, which are censored moves: the expected moves on them, given a kernel."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import block_rows, ones_at, row_index, summing
from trackmdp.arrays.types import Array, BoolArray, IndexArray

_AT_ONCE = 2**14
"""Paths with hidden cells that are drawn at once."""
_ENTRIES = 2**23
"""Cells where paths may be, and pairs of such cells, that are worked on at once: some 100 MB an array."""
_SAMPLE = 64
"""Paths from which the cells of all others are reckoned."""
_FULL, _FULL_ENTRIES = 1 / 8, 2**20
"""Share of moves that are possible from which masses are dense, as targets may soon be in most cells; and numbers of
such a mass."""


@dataclass(frozen=True)
class ObservedPaths:
    """K observed paths from one detection to the next.

    Attributes:
        start: `[K]`, located cell.
        misses: `[K]`, n, how often the target was missed on the way.
        sensed: `[K * (t_max + 1), M]` sparse; row `k * (t_max + 1) + t` has the probability of a report in each cell
            by the set of the miss t of path k. Rows of t >= n are not read.
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

    def sets(self, misses: int) -> list[sparse.csr_array]:
        """`[K, M]` the sets of the first `misses` misses."""
        # Rows t, t + (t_max + 1), ...: the set of miss t of every path.
        return [self.sensed[t :: self.choices] for t in range(misses)]

    def pick(self, paths: IndexArray) -> Self:
        """The `paths` of these numbers, in their order."""
        # With t_max = 1, path 3 has the rows 3 * 2 + (0, 1) = 6, 7.
        rows = block_rows(paths, self.choices)
        columns = {name: part[paths] for name, part in vars(self).items() if name != "sensed"}
        return replace(self, sensed=self.sensed[rows], **columns)

    @classmethod
    def of(cls, parts: Sequence[ObservedPaths], cells: int) -> Self:
        """All paths of `parts`, one after the other, on a grid of so many cells."""
        sets = [sparse.csr_array((0, cells)), *(part.sensed for part in parts)]
        columns: dict[str, Any] = {"sensed": sparse.vstack(sets)}
        for name in {each.name for each in fields(cls)} - {"sensed"}:
            none = np.zeros(0, np.int64)
            columns[name] = np.concatenate([none, *(getattr(part, name) for part in parts)])
        return cls(**columns)


def each_once(paths: ObservedPaths) -> tuple[ObservedPaths, Array]:
    """Equal paths once, and how often each occurs.

    Sets are compared by two sums of 64 random bits per (miss, cell): unequal ones agree with probability 2^-128.
    """
    choices, m, count = paths.choices, paths.sensed.shape[1], len(paths.start)
    # Row k * (t_max + 1) + t belongs to miss t of path k; rows of t >= n were never used, and must not make paths
    # differ.
    path, miss = np.divmod(row_index(paths.sensed), choices)
    bits = np.where(miss < paths.misses[path], paths.sensed.data.view(np.uint64) | 1, 0)
    marks = np.random.default_rng(0).integers(2**63, size=(2, choices * m), dtype=np.uint64)
    place = (path, miss * m + paths.sensed.indices)
    # Unsigned sums and products wrap around: equal sets have equal sums, in any order.
    sums = sparse.csr_array((bits, place), shape=(count, choices * m)) @ marks.T
    known = np.stack([paths.start, paths.misses, paths.end], axis=1).astype(np.uint64)
    keys = np.concatenate([known, sums], axis=1)
    _, first, copies = np.unique(keys, axis=0, return_index=True, return_counts=True)
    return paths.pick(first), copies.astype(np.float64)


def expected_moves(
    kernel: sparse.csr_array, paths: ObservedPaths, copies: Array
) -> sparse.csr_array:
    """`[M, M + 1]` expected moves on the censored paths, given the kernel.

    With f_t the undetected mass and l_t the likelihood of the later observations, the move i -> j at step t of
    a path is made with probability f_t(i) P_ij l_{t+1}(j) / (likelihood of the path); P_ij is multiplied in at the end.
    """
    if kernel.nnz > _FULL * math.prod(kernel.shape):
        return kernel.multiply(_dense_pairs(kernel.toarray(), paths, copies))
    m, moves, backward, leave = kernel.shape[0], *_directions(kernel)
    # Sums at the stored entries of the kernel alone: all other moves have probability 0.
    possible, made = _support(kernel), sparse.csr_array(kernel.shape)
    for n, ends, part in _parts(moves, paths, paths.end <= m):
        some, each = paths.pick(part), np.arange(len(part))
        sensed = some.sets(n)
        forward = _forward(moves, some, sensed)
        # 1 at all cells if the end is unknown
        later = _ending(backward, leave, forward[n], some.end) if ends else _support(forward[n])
        weight = copies[part] / np.maximum(forward[n].multiply(later).sum(axis=1), 1e-300)
        if ends:
            # The last move ends in the known cell, or in the exit, column M: f_n(i) at (i, end), weighted.
            last = sparse.csr_array((weight, (each, some.end)), shape=(len(part), m + 1))
            made = made + _pairs(forward[n], last, possible)
        for t in range(n - 1, -1, -1):
            later = _hidden(later, sensed[t])
            made = made + _pairs(forward[t], sparse.diags_array(weight) @ later, possible)
            # l_t(i) = sum_j P_ij l_{t+1}(j), with l zero where the cell was sensed: there it would have been detected.
            if t > 0:  # no move comes before the first one
                later = (later @ backward[:m]).multiply(_support(forward[t]))
    return made.multiply(kernel)


def _dense_pairs(kernel: Array, paths: ObservedPaths, copies: Array) -> Array:
    """`[M, M + 1]` sums of f_t(i) l_{t+1}(j) / (likelihood of the path), as of `expected_moves`."""
    m, made, count = len(kernel), np.zeros(kernel.shape), max(1, _FULL_ENTRIES // len(kernel))
    moves = np.ascontiguousarray(kernel[:, :m])
    # 1 at all cells if the end is unknown
    ends = np.concatenate([kernel.T, np.ones((1, m))])
    for n, part in _by_misses(paths, count):
        some = paths.pick(part)
        missed = [1.0 - sensed.toarray() for sensed in some.sets(n)]
        forward: list[Any] = [summing(some.start, m).T]
        for each in missed:
            forward.append((forward[-1] @ moves) * each)
        later = ends[some.end]
        weight = copies[part] / np.maximum((forward[n] * later).sum(axis=1), 1e-300)
        made += (summing(some.end, m + 2) @ (forward[n] * weight[:, None]))[: m + 1].T
        for t in range(n - 1, -1, -1):
            later = missed[t] * later
            made[:, :m] += forward[t].T @ (weight[:, None] * later)
            if t > 0:  # no move comes before the first one
                later = later @ moves.T
    return made


def _by_misses(paths: ObservedPaths, most: int) -> Iterator[tuple[int, IndexArray]]:
    """Numbers of misses, and those of the paths with as many, `most` at once."""
    for n in np.unique(paths.misses):
        whole = np.flatnonzero(paths.misses == n)
        for begin in range(0, len(whole), most):
            yield int(n), whole[begin : begin + most]


def _pairs(
    before: sparse.csr_array, after: sparse.csr_array, possible: sparse.csr_array
) -> sparse.csr_array:
    """At the `possible` (i, j) the sum over the paths k of before(k, i) after(k, j); `[M, M + 1]`."""
    pairs = sparse.csr_array(before.T) @ after
    pairs.resize(possible.shape)
    return pairs.multiply(possible)


def _directions(kernel: sparse.csr_array) -> tuple[sparse.csr_array, sparse.csr_array, Array]:
    """Of a kernel `[M, M + 1]`: moves `[M, M]`, by their ends `[M + 1, M]` with nothing at M, and exits `[M]`."""
    m = kernel.shape[0]
    moves = kernel[:, :-1]
    backward = sparse.csr_array(moves.T)
    backward.resize((m + 1, m))
    return moves, backward, kernel[:, [m]].toarray().ravel()


def _ending(
    backward: sparse.csr_array, leave: Array, forward: sparse.csr_array, end: IndexArray
) -> sparse.csr_array:
    """`[K, M]` probability of the end of each path from each cell where it may be, in `forward`."""
    support = _support(forward)
    # From every cell the target may exit: row M of the transposed kernel is dense, but a path is in few cells.
    gone = sparse.diags_array((end == len(leave)).astype(np.float64))
    left = gone @ support @ sparse.diags_array(leave)
    return backward[end].multiply(support) + left


def _support(mass: sparse.csr_array) -> sparse.csr_array:
    """1 where there is mass."""
    return (mass > 0).astype(np.float64)


def _parts(
    moves: sparse.csr_array, paths: ObservedPaths, seen: BoolArray
) -> Iterator[tuple[int, bool, IndexArray]]:
    """Paths with as many misses, their ends seen or not: n, whether, and their numbers, `_ENTRIES` at once."""
    for n, ends in itertools.product(np.unique(paths.misses), (True, False)):
        whole = np.flatnonzero((paths.misses == n) & (seen == ends))
        if not len(whole):
            continue
        some = paths.pick(whole[:: max(1, len(whole) // _SAMPLE)])
        cells = np.array([np.diff(mass.indptr) for mass in _forward(moves, some, some.sets(n))])
        entries = cells.sum(axis=0)
        # Pairs of all paths are no more than those of all cells.
        if moves.shape[0] ** 2 > _ENTRIES:
            entries = np.maximum(entries, (cells[:-1] * cells[1:]).max(axis=0, initial=0))
        count = max(1, int(_ENTRIES / max(1.0, entries.mean())))
        for begin in range(0, len(whole), count):
            yield int(n), ends, whole[begin : begin + count]


def _forward(
    moves: sparse.csr_array, paths: ObservedPaths, sensed: Sequence[sparse.csr_array]
) -> list[sparse.csr_array]:
    """`[K, M]` undetected mass of each path, at its start and after each set."""
    count = len(paths.start)
    shape = (count, moves.shape[0])
    mass = [ones_at(np.arange(count), paths.start, shape, np.float64)]
    for each in sensed:
        mass.append(_hidden(mass[-1] @ moves, each))
    return mass


def hidden_cells(
    kernel: sparse.csr_array, paths: ObservedPaths, rng: np.random.Generator
) -> IndexArray:
    """The cells of all misses, path by path in order, drawn given the paths and the kernel `[M, M + 1]`.

    Forward filtering, backward sampling: the last hidden cell i is drawn in proportion to f_n(i) P_ij, j the end, and
    each earlier one alike, given the one after it. All ends are known.
    """
    moves, backward, leave = _directions(kernel)
    place = np.cumsum(paths.misses) - paths.misses
    found = np.empty(int(paths.misses.sum()), np.int64)
    for n, part in _by_misses(paths, _AT_ONCE):
        some = paths.pick(part)
        forward, after = _forward(moves, some, some.sets(n)), some.end
        for t in range(n, 0, -1):
            later = _ending(backward, leave, forward[t], after)
            likely = forward[t].multiply(later)
            after = drawn_columns(likely, some.start, rng)
            found[place[part] + t - 1] = after
    return found


def drawn_columns(
    weights: sparse.csr_array, default: IndexArray, rng: np.random.Generator
) -> IndexArray:
    """`[K]` one column of each row of `weights` `[K, M]`, in proportion to its entries; of an empty row `default`."""
    sums = np.concatenate([[0.0], np.cumsum(weights.data)])
    low, high = sums[weights.indptr[:-1]], sums[weights.indptr[1:]]
    wanted = low + rng.random(len(low)) * (high - low)
    entry = np.searchsorted(sums, wanted, side="right") - 1
    entry = np.clip(entry, weights.indptr[:-1], np.maximum(weights.indptr[1:] - 1, 0))
    columns = np.append(weights.indices, 0)[np.minimum(entry, len(weights.indices))]
    return np.where(high > low, columns, default).astype(np.int64)


def _hidden(mass: sparse.csr_array, sensed: sparse.csr_array) -> sparse.csr_array:
    """`mass` less the reported part of it: `sensed` holds the sensors' p_d."""
    left = mass - mass.multiply(sensed)
    left.eliminate_zeros()
    return left
