"""What a training run has come to, in memory and in its folder."""

from __future__ import annotations

import io
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.durable import write_bytes
from trackmdp.policies.policy import Policy
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.solution import Solution
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.training.sealing import write_summary
from trackmdp.training.summary import summarize
from trackmdp.training.trainer import Trainer
from trackmdp.world.model import World

__all__ = ["Metrics", "Run", "complete"]

Metrics = dict[str, list[float | int | None]]
"""Columns by their names, as in `metrics.csv`: one value for each logged iteration, None for what was not measured."""


@dataclass(frozen=True, eq=False)
class Run:
    """A training run that has ended.

    Attributes:
        policy: what was learned.
        evaluation: its figures, exact where there is a motion model, else on the held-out tracks.
        metrics: figures of the iterations.
        summary: the content of `summary.json`.
        folder: where its files are; None where none were written.
        solution: the optimum, or a bracket of it, where it was solved for at the end.
    """

    policy: Policy
    evaluation: Evaluation
    metrics: Metrics
    summary: dict[str, Any]
    folder: Path | None = None
    solution: Solution | None = None


class Table(Callback):
    """Keeps the rows of all iterations in memory."""

    def __init__(self) -> None:
        self.columns: Metrics = {}

    def on_update(self, trainer: Training, row: Row) -> None:  # noqa: ARG002
        """Append the row."""
        for key, value in row.items():
            self.columns.setdefault(key, []).append(value)


def complete(trainer: Trainer) -> Run:
    """Train to the end, solve for the optimum where the config asks for it, and write `policy.npz` and `summary.json`.

    Raises:
        UserError, Preempted, RunError: see `Trainer.run`.
    """
    began, used = time.monotonic(), time.process_time()
    table = Table()
    trainer.callbacks.append(table)
    score = trainer.run()
    policy, solution = trainer.policy(), _solve(trainer)
    if solution is not None:
        score = trainer.evaluator.tighten(solution.upper, score)
    times = {
        "wall_seconds": time.monotonic() - began + trainer.start.seconds,
        "cpu_seconds": time.process_time() - used,
    }
    summary = summarize(trainer, score, solution, times)
    if trainer.folder is not None:
        _write_policy(trainer.folder / "policy.npz", policy, score.evaluation)
        # Last, for a folder with a summary is a finished run.
        write_summary(trainer.folder, summary)
    return Run(policy, score.evaluation, table.columns, summary, trainer.folder, solution)


def _solve(trainer: Trainer) -> Solution | None:
    """The certified optimum, where it is asked for; there is none for episodes truncated by `grid.max_steps`."""
    cfg, problem = trainer.config, trainer.problem
    if not cfg.optimal.enabled or problem.max_steps is not None or not isinstance(problem, World):
        return None
    with trainer.console.status(f"solving for the optimum, at most {cfg.optimal.time_limit:g} s"):
        return optimal.solve(problem, time_limit=cfg.optimal.time_limit)


def _write_policy(file: Path, policy: Policy, evaluation: Evaluation) -> None:
    stream, table = io.BytesIO(), policy.dense()
    np.savez_compressed(stream, chains=np.packbits(table), shape=np.array(table.shape), value=evaluation.value)
    write_bytes(file, stream.getvalue())
