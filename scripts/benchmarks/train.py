"""Frames per second of collecting and learning, for each algorithm at its defaults."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import trackmdp as tm
from benchmarks.words import Row, world_of
from trackmdp.config import GROUPS
from trackmdp.training.callbacks import Callback, Training
from trackmdp.training.callbacks import Row as Figures


class Enough(Exception):
    """The time for a learner is over."""


class Timed(Callback):
    """Counts wall and CPU seconds of learning, and ends it after `limit` wall seconds."""

    def __init__(self, limit: float) -> None:
        self.limit, self.frames = limit, 0
        self.wall = self.cpu = 0.0

    def on_start(self, trainer: Training) -> None:  # noqa: ARG002
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def on_update(self, trainer: Training, row: Figures) -> None:  # noqa: ARG002
        self.wall = time.perf_counter() - self._wall
        self.cpu = time.process_time() - self._cpu
        self.frames = trainer.position.frames
        if self.wall > self.limit:
            raise Enough


def rows(
    words: Mapping[str, str],
    algos: tuple[str, ...] = tuple(GROUPS["algo"]),
    seconds: float = 10.0,
    seed: int = 0,
    threads: int = 1,
    device: str = "cpu",
) -> Iterator[Row]:
    """One row for each algorithm; `whole` where it came to its end within `seconds`."""
    world = world_of(words)
    # One evaluation, at the end: the learners are timed, not the evaluator.
    more = {"evaluation.every": 10**9, "optimal.enabled": False, "device": device}
    for name in algos:
        clock, whole = Timed(seconds), True
        try:
            tm.train(world, name, seed=seed, callbacks=[clock], threads=threads, **more)
        except Enough:
            whole = False
        yield {
            "algo": name,
            "whole": whole,
            "per_second": clock.frames / clock.wall,
            "cpu_us_each": 1e6 * clock.cpu / clock.frames,
        }
