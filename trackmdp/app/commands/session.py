"""A training run with all that belongs to it, begun anew or taken up where an earlier process left it."""

from __future__ import annotations

import io
import json
import math
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from rich.console import Console

from trackmdp.build import make_algorithm, make_collector, make_problem
from trackmdp.config import McapConfig, TrainConfig
from trackmdp.config.resume import config_text
from trackmdp.durable import write_bytes, write_json, write_text
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.record import Chains
from trackmdp.errors import UserError
from trackmdp.seeding import seed_global
from trackmdp.training import checkpoint, memory
from trackmdp.training.devices import make_device
from trackmdp.training.display import Display
from trackmdp.training.evaluate import chains_of
from trackmdp.training.evaluator import Score
from trackmdp.training.held_out import make_evaluator
from trackmdp.training.loop import Intervals, Position, train
from trackmdp.training.metrics import MetricsLog
from trackmdp.training.state import capture, find, restore, take_weights
from trackmdp.world.model import Array, BoolArray, World
from trackmdp.world.tracks import Problem, Recorded

__all__ = ["Session"]


class Session:
    """World, learner, collector, evaluator and logs of one run; a context manager that ends what it began.

    Raises:
        UserError: the config asks for what is not there, for more memory than there is, or for a run that is not this.
    """

    def __init__(self, cfg: TrainConfig, folder: Path, console: Console, problem: Problem | None = None) -> None:
        self.cfg, self.folder, self.console = cfg, folder, console
        self._opened = ExitStack()
        torch.set_num_threads(cfg.threads)
        self.device = make_device(cfg.device)
        self.world = make_problem(cfg) if problem is None else problem
        console.print(memory.check(cfg, self.world.task, self.device))
        state, passed_over = find(cfg, folder, self.device)
        for line in passed_over:
            console.print(f"passed over: {line}")
        with self._opened as opened:
            self._build(state, opened)
            self._opened = opened.pop_all()

    def _build(self, state: dict[str, Any] | None, opened: ExitStack) -> None:
        cfg, folder = self.cfg, self.folder
        seed_global(cfg.seed)
        self.algorithm = make_algorithm(cfg, self.world, self.device)
        done = state["position"]["frames"] if state else 0
        self.collector = make_collector(cfg, self.world, self.algorithm, self.device, done=done)
        opened.callback(self.collector.shutdown)
        self.evaluator = make_evaluator(self.world)
        self.start = self._start(state)
        self._best = state["best"] if state else -math.inf
        _write_inputs(cfg, self.world, folder, resumed=state is not None)
        plan = {"iterations": self.algorithm.iterations, "upper_bound": self.evaluator.upper}
        write_json(folder / "plan.json", plan)  # for those who watch the run
        events, written = cfg.log.name == "tensorboard", state["metrics"] if state else 0
        self.metrics = MetricsLog(folder, tensorboard=events, position=written, frames=self.start.frames)
        opened.callback(self.metrics.close)
        self.log = _episode_log(cfg, self.world, folder, state["recorded"] if state else None)
        if self.log is not None:
            opened.callback(self.log.close)

    def _start(self, state: dict[str, Any] | None) -> Position:
        """After the last checkpoint, or from scratch, perhaps with the weights of another run."""
        if state is not None:
            start = restore(state, self.algorithm, self.collector)
            self.console.print(f"goes on after iteration {start.iteration}, {start.frames:,} frames")
            return start
        if self.cfg.init_from is not None:
            taken = take_weights(self.algorithm, Path(self.cfg.init_from), self.device)
            self.console.print(f"weights from {self.cfg.init_from}: {', '.join(taken)}")
        return Position()

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._opened.close()

    def train(self) -> tuple[Score, Position]:
        """Run to the end; the last score and position."""
        cfg, start = self.cfg, self.start
        every = Intervals(cfg.evaluation.every, cfg.log.every, cfg.checkpoint.every, cfg.checkpoint.seconds)
        title = f"{cfg.algo.name} seed {cfg.seed}"
        with Display(self.console, title, self.algorithm.iterations, start.iteration, start.frames) as display:
            return train(
                self.algorithm,
                self.collector,
                self.evaluator,
                self.metrics,
                display,
                every,
                self._save,
                start,
                self._record,
            )

    def chains(self) -> BoolArray:
        """`[M, t_max + 1, M]` of the policy as it is now."""
        return chains_of(self.algorithm.actor, self.world.task, self.device)

    def _save(self, at: Position, score: Score) -> None:
        better = score.evaluation.aihtr > self._best
        self._best = max(self._best, score.evaluation.aihtr)
        written = self.metrics.position
        recorded = self.log.policies if self.log is not None else None
        state = capture(
            self.cfg, self.algorithm, self.collector, at, metrics=written, best=self._best, recorded=recorded
        )
        checkpoint.save(self.folder / "checkpoints", at.iteration, state, keep=self.cfg.checkpoint.keep, best=better)

    def _record(self, iteration: int, chains: np.ndarray) -> None:
        """Log episodes of the evaluation after the first iteration, every k-th one, and the last."""
        log = self.cfg.log
        if self.log is None or not isinstance(log, McapConfig):
            return
        if (
            iteration in (1, self.algorithm.iterations)
            or iteration % (self.cfg.evaluation.every * log.evaluations) == 0
        ):
            self.log.record(Chains(chains), {"label": f"iteration {iteration}"}, log.episodes, iteration)


def _episode_log(cfg: TrainConfig, world: Problem, folder: Path, policies: int | None) -> EpisodeLog | None:
    """The log of simulated episodes, where it is asked for."""
    if not isinstance(cfg.log, McapConfig):
        return None
    assert isinstance(world, World)
    return EpisodeLog(
        folder,
        world,
        seed=cfg.seed,
        config=config_text(cfg),
        layout=cfg.log.layout,
        policies=policies,
        command="train",
    )


def _write_inputs(cfg: TrainConfig, world: Problem, folder: Path, *, resumed: bool) -> None:
    """`config.yaml`, and `kernel.npy` or `tracks.json`: what the run takes in.

    Raises:
        UserError: the run that goes on was begun with another kernel, or with other tracks.
    """
    name, what = ("kernel.npy", "kernel") if isinstance(world, World) else ("tracks.json", "recording")
    file = folder / name
    if resumed and not _same(file, world):
        raise UserError(
            f"{file}: the run's {what} is not the one that its config describes now; it cannot change on resume"
        )
    write_text(folder / "config.yaml", config_text(cfg))
    write_bytes(file, _npy(world.kernel.toarray()) if isinstance(world, World) else _described(world))


def _same(file: Path, world: Problem) -> bool:
    if isinstance(world, World):
        return np.array_equal(np.load(file, allow_pickle=False), world.kernel.toarray())
    return file.read_bytes() == _described(world)


def _npy(table: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, table)
    return buffer.getvalue()


def _described(world: Recorded) -> bytes:
    """Which tracks these are."""
    parts = {"learned_from": world.tracks, "held_out": world.held_out}
    content = {
        name: {"tracks": len(part), "cells": len(part.cells), "sha256": part.digest()} for name, part in parts.items()
    }
    return (json.dumps(content, indent=2) + "\n").encode()
