"""A motion with hidden modes, fitted to paths of known cells by expectation-maximisation (Baum et al. 1970).

Policy iteration on paths stops at plans of which no part can change alone for the better. A plan for this motion, which
the solver searches on far fewer states, is another start. What the modes mean is left open: for targets with a heading
or a velocity they become headings and velocities, which the last moves alone show only in part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.shrinkage import without
from trackmdp.arrays.entries import among, per_row, ranks, summing
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.task import Task
from trackmdp.world.model import World

_GUESSES, _FIRST_ROUNDS, _FIRST, _REFINED = 8, 15, 40_000, 2
"""First guesses, and the rounds after which the most likely ones go on, on so many moves; and how many do. With twelve
modes the others end up to .04 a move below them."""
_ROUNDS, _MOST, _LONGEST = 45, 200_000, 100
"""Rounds after them, and moves: with twelve modes a round takes a tenth of a second. All paths take a step at once, and
longer ones are cut. After 20 rounds the likelier of two fits can be the one that ends lower."""
_AGAIN = 15
"""Rounds from an earlier fit, which most of the paths have made."""
_FREE, _SPARED = 10, 2e-5
"""Rounds until few modes shall follow each other: from then on each expected number of moves counts as less by this
share of all moves (a Dirichlet prior below 1), so that most become none and the solver has fewer entries."""
_SPREAD = 0.3
"""Of a first guess: how evenly the modes after a move are likely (Dirichlet)."""
_FLOOR = 0.01
"""Moves of each pair of cells that are always counted, so that no path becomes impossible."""


@dataclass(frozen=True)
class Fit:
    """A target with hidden modes, as some paths show it to move.

    Attributes:
        paths: moves, a part of them where there are many.
        moves: the motion, for each pair of cells.
    """

    paths: _Paths
    moves: Array

    def world(self, task: Task, least: float) -> World:
        """A task with that target; moves less likely than `least` are left out."""
        paths, modes = self.paths, self.moves.shape[1]
        # Half an exit in one more move, as of pooled moves: on recordings that all stop no episode would end.
        moves = self.moves * (1.0 - 0.5 / (paths.count + 1))
        pair, mode, to = np.nonzero(moves * paths.inside)
        place = (paths.before[pair] * modes + mode, paths.after[pair] * modes + to)
        shape = (task.num_cells * modes,) * 2
        kernel = sparse.csr_array((moves[pair, mode, to], place), shape=shape)
        return World.of(task, without(kernel, least), modes=modes, max_steps=None)


def fit_modes(
    tracks: Tracks, num_cells: int, modes: int, seed: int, before: Fit | None = None
) -> Fit:
    """The most likely motion with hidden modes.

    Args:
        tracks: the paths; random ones, where there are many points.
        num_cells: M.
        modes: K.
        seed: of the tracks and of the first guesses.
        before: of most of the tracks, where there is one: in place of guesses.
    """
    rng = np.random.default_rng(seed)
    few, paths = (_Paths.of(tracks, num_cells, most, rng) for most in (_FIRST, _MOST))
    if before is not None:
        return Fit(paths, _after(paths, before.paths.on(paths, before.moves), _AGAIN, 0)[0])
    guesses = sorted(
        (_guessed(few, modes, rng) for _ in range(_GUESSES)), key=lambda guess: -guess[1]
    )
    fits = [_after(paths, few.on(paths, moves), _ROUNDS, _FREE) for moves, _ in guesses[:_REFINED]]
    return Fit(paths, max(fits, key=lambda fit: fit[1])[0])


def _guessed(paths: _Paths, modes: int, rng: np.random.Generator) -> tuple[Array, float]:
    """A random motion after the first rounds, and its log-likelihood as of `_after`."""
    count = len(paths.share)
    after = rng.dirichlet(np.full(modes, _SPREAD), (count, modes))
    moves = paths.share[:, None, None] * rng.standard_gamma(1.0, (count, modes, 1)) * after
    return _after(paths, paths.normed(paths.ending(moves)), _FIRST_ROUNDS, _FIRST_ROUNDS)


def _after(paths: _Paths, moves: Array, rounds: int, free: int) -> tuple[Array, float]:
    """A motion after some rounds, the first of them `free`, and the log-likelihood before the last one."""
    likelihood = 0.0
    for done in range(rounds):
        moves, likelihood = paths.fitted(moves, _SPARED if done >= free else 0.0)
    return moves, likelihood


def _pieces(line: Tracks) -> tuple[IndexArray, IndexArray]:
    """Where pieces of closed tracks begin, and their moves; a track of 250 moves has pieces of 100, 100 and 50."""
    moves = line.lengths - 1
    track = np.repeat(np.arange(len(moves)), -(-moves // _LONGEST))
    offset = ranks(track) * _LONGEST
    return line.first[track] + offset, np.minimum(moves[track] - offset, _LONGEST)


@dataclass(frozen=True)
class _Paths:
    """Moves between known cells, in the order of their steps.

    A motion is `[P, K, K]`: for each pair of cells and the modes before and after, the probability of the move, given
    the first cell and the mode before.

    Attributes:
        code: `[P]`, numbers of the pairs of cells that some move was seen between, in increasing order.
        before: `[P]`, the first cell of each.
        after: `[P]`, the second; M for an exit.
        inside: `[P, 1, 1]`, whether it is in the grid.
        share: `[P]`, of all moves from the first cell.
        steps: for each step the pairs `[B]` of the paths that are so long, the longest first.
    """

    code: IndexArray
    before: IndexArray
    after: IndexArray
    inside: BoolArray
    share: Array
    steps: Sequence[IndexArray]

    @classmethod
    def of(cls, tracks: Tracks, num_cells: int, most: int, rng: np.random.Generator) -> Self:
        """Some `most` moves, on random tracks on so many cells."""
        line = tracks.closed(num_cells)
        first, moves = _pieces(line)
        order = rng.permutation(len(first))
        order = order[: 1 + np.searchsorted(np.cumsum(moves[order]), most)]
        order = order[np.argsort(-moves[order], kind="stable")]
        first, moves = first[order], moves[order]
        number = line.cells[:-1] * (num_cells + 1) + line.cells[1:]
        # Tracks of 3, 2 and 2 moves: three pairs in the steps 0 and 1, one in step 2.
        steps = [number[first[moves > step] + step] for step in range(moves.max(initial=1))]
        code, place, times = np.unique(
            np.concatenate(steps), return_inverse=True, return_counts=True
        )
        before, after = np.divmod(code, num_cells + 1)
        share = times / per_row(before, times.astype(np.float64), num_cells)[before]
        inside = (after < num_cells)[:, None, None]
        ends = np.cumsum([len(step) for step in steps])
        return cls(code, before, after, inside, share, np.split(place, ends[:-1]))

    @cached_property
    def count(self) -> int:
        """Of all moves."""
        return sum(len(pairs) for pairs in self.steps)

    @cached_property
    def _by_pair(self) -> tuple[IndexArray, IndexArray]:
        """The moves of all steps, one step after the other, in order of their pairs; and where each pair ends there."""
        pair = np.concatenate(self.steps)
        return np.argsort(pair, kind="stable"), np.cumsum(np.bincount(pair))

    def normed(self, moves: Array) -> Array:
        """`[P, K, K]` numbers of moves as probabilities."""
        total = summing(self.before, int(self.before.max(initial=-1)) + 1) @ moves.sum(axis=2)
        return moves / total[self.before, :, None]

    def fitted(self, moves: Array, spared: float = 0.0) -> tuple[Array, float]:
        """The most likely motion for the moves that are expected by `moves`; and the log-likelihood of `moves`."""
        expected, likelihood = self._expected(moves)
        expected -= spared * self.count * self.inside
        return self.normed(np.maximum(expected, 0.0) + self._floor(moves)), likelihood

    def on(self, others: _Paths, moves: Array) -> Array:
        """A motion for the pairs of `others`, the floor for pairs that were not seen here."""
        place, known = among(self.code, others.code)
        found = np.where(known[:, None, None], moves[place], 0.0)
        return others.normed(found + others._floor(found))

    def ending(self, moves: Array) -> Array:
        """The numbers of moves with all exits to the first mode: there is none after them."""
        last = moves.sum(axis=2, keepdims=True) * (np.arange(moves.shape[2]) == 0)
        return np.where(self.inside, moves, last)

    def _floor(self, moves: Array) -> Array:
        even = np.broadcast_to(self.share[:, None, None] / moves.shape[2], moves.shape)
        return _FLOOR * self.ending(even)

    def _expected(self, moves: Array) -> tuple[Array, float]:
        """`[P, K, K]` expected number of moves, and the log-likelihood (forward and backward)."""
        each, modes = moves.astype(np.float32), moves.shape[1]
        # Of the modes given the moves so far; each is as likely at the start.
        known, chances = [np.full((len(self.steps[0]), modes), 1.0 / modes, np.float32)], []
        for pair in self.steps:
            reached = (known[-1][: len(pair), None] @ each[pair])[:, 0]
            chances.append(reached.sum(axis=1))
            known.append(reached / chances[-1][:, None])
        # Of the later moves by the mode after each one; paths that end with it have none.
        later, onward = np.ones((0, modes), np.float32), []
        for pair, chance in zip(reversed(self.steps), reversed(chances), strict=True):
            ends = np.ones((len(pair) - len(later), modes), np.float32)
            onward.append(np.concatenate([later, ends]) / chance[:, None])
            later = (each[pair] @ onward[-1][:, :, None])[:, :, 0]
        # A move from k to j counts by P(k | before) P(move, j | k) P(later | j) / P(move, later | before).
        before = [mode[: len(pair)] for pair, mode in zip(self.steps, known, strict=False)]
        order, last = self._by_pair
        parts = [
            np.split(np.concatenate(part)[order], last[:-1]) for part in (before, onward[::-1])
        ]
        counts = moves * np.stack([one.T @ other for one, other in zip(*parts, strict=True)])
        return counts, float(sum(np.log(each).sum(dtype=np.float64) for each in chances))
