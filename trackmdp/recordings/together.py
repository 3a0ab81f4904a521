"""Recorded tracks that several targets follow at the same time.

Tracks are together where their times overlap: each begins so many steps after the first of them as it does in the
recording. Without times all begin at once, and any are together. Where fewer overlap than are wanted, the others are
targets that are never there.

The place of a target is its point, P once it is gone, and p - w P where it will be at point p in w steps, so that a
step adds P. Example with P = 10: -13 is point 7 in two steps; then -3, then 7.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from trackmdp.arrays.types import BoolArray, Indices
from trackmdp.recordings.tracks import Tracks


class Together:
    """Tracks that run at the same time.

    Args:
        tracks: of N targets.
        count: K, tracks of one episode, at most.
    """

    def __init__(self, tracks: Tracks, count: int) -> None:
        self.tracks, self.count = tracks, count
        begins = tracks.begins
        self._begin = np.zeros(len(tracks), np.int64) if begins is None else begins
        self._end = self._begin + tracks.lengths
        self._order = np.argsort(self._begin, kind="stable")
        self._sorted = self._begin[self._order]
        self._longest = int(tracks.lengths.max())

    def overlapping(self, leader: int) -> Indices:
        """The other tracks with a step in common with track `leader`, by their begin."""
        begin, end = self._begin[leader], self._end[leader]
        low, high = np.searchsorted(self._sorted, [begin - self._longest, end])
        near = self._order[low:high]
        return near[(self._end[near] > begin) & (near != leader)]

    def drawn(
        self, leader: int, rng: np.random.Generator, free: BoolArray | None = None
    ) -> Indices:
        """`[K]`, a track and others that overlap with it, drawn at random from those that are `free`; -1 for none."""
        found = np.full(self.count, -1)
        found[0], others = leader, self.overlapping(leader)
        others = others if free is None else others[free[others]]
        chosen = rng.permutation(others)[: self.count - 1]
        found[1 : 1 + len(chosen)] = chosen
        return found

    @cached_property
    def groups(self) -> Indices:
        """`[G, K]`, all tracks, each in one group: the same in every process."""
        rng, free, found = np.random.default_rng(0), np.ones(len(self.tracks), bool), []
        shuffled = rng.permutation(len(self.tracks))
        for leader in shuffled[np.argsort(self._begin[shuffled], kind="stable")]:
            if free[leader]:
                found.append(self.drawn(leader, rng, free))
                free[found[-1][found[-1] >= 0]] = False
        return np.stack(found)

    def places(self, groups: Indices, late: Indices | int = 0) -> Indices:
        """`[G, K]`, places of the targets of `groups` `[G, K]`, `late` `[G]` steps after the first of them begins."""
        points, here = len(self.tracks.cells), groups >= 0
        begin = self._begin[groups]
        start = np.where(here, begin, np.iinfo(np.int64).max).min(axis=1) + late
        age = start[:, None] - begin
        point = self.tracks.first[groups] + np.maximum(age, 0) + np.minimum(age, 0) * points
        return np.where(here & (age < self.tracks.lengths[groups]), point, points)

    def from_point(self, point: int, rng: np.random.Generator) -> Indices:
        """`[K]`, places of a target at a point of its track, and of others that overlap with it."""
        leader = int(np.searchsorted(self.tracks.first, point, side="right")) - 1
        group = self.drawn(leader, rng)
        now = self._begin[leader] + point - self.tracks.first[leader]
        return self.places(group[None], now - self._begin[group[group >= 0]].min())[0]
