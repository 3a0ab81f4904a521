"""The training loop; it names no algorithm."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torchrl.collectors import BaseCollector

from trackmdp.algos.common import Algorithm
from trackmdp.training.display import Display
from trackmdp.training.evaluate import chains_of
from trackmdp.training.judge import Judge, Verdict
from trackmdp.training.metrics import MetricsLog

__all__ = ["Intervals", "train"]


@dataclass(frozen=True)
class Intervals:
    """Iterations from one exact evaluation, metrics row or checkpoint (0 = only at the end) to the next."""

    evaluate: int
    log: int
    checkpoint: int


def train(
    algorithm: Algorithm,
    collector: BaseCollector,
    judge: Judge,
    metrics: MetricsLog,
    display: Display,
    every: Intervals,
    save: Callable[[int, int], Any],
) -> tuple[Verdict, int]:
    """Collect, learn, judge, log and save, until the algorithm's iterations are done.

    Args:
        algorithm: learns from each batch; its `actor` is judged.
        collector: yields batches `[B, time]` until its frames are spent.
        judge: exact figures of the actor's chains.
        metrics: gets one row every `every.log` iterations, and the last.
        display: gets the figures of the last evaluation after each iteration.
        every: the intervals.
        save: called with (iteration, frames) when a checkpoint is due.

    Returns:
        The last verdict and the number of frames collected.
    """
    batches, frames, started = iter(collector), 0, time.monotonic()
    for iteration in range(1, algorithm.iterations + 1):
        batch = next(batches, None)
        frames += batch.numel() if batch is not None else 0
        diagnostics = algorithm.step(batch)
        if batch is not None:
            collector.update_policy_weights_()
        last = iteration == algorithm.iterations
        judged = last or iteration == 1 or iteration % every.evaluate == 0
        if judged:
            verdict = judge.score(chains_of(algorithm.actor, judge.world, algorithm.device))
        if last or iteration % every.log == 0:
            metrics.write(_row(iteration, frames, verdict if judged else None, diagnostics, time.monotonic() - started))
        if last or (every.checkpoint and iteration % every.checkpoint == 0):
            save(iteration, frames)
        display.update(iteration, frames, verdict.evaluation.aihtr, judge.upper - verdict.evaluation.aihtr)
    return verdict, frames


def _row(
    iteration: int, frames: int, verdict: Verdict | None, diagnostics: dict[str, float], seconds: float
) -> dict[str, float | int | None]:
    """Counters, exact figures (empty between evaluations), diagnostics, and last the columns that time decides."""
    evaluation = verdict.evaluation if verdict else None
    return {
        "iteration": iteration,
        "frames": frames,
        "aihtr": evaluation.aihtr if evaluation else None,
        "regret_per_step": verdict.regret_per_step if verdict else None,
        "accuracy": evaluation.accuracy if evaluation else None,
        "sensors_per_step": evaluation.sensors_per_step if evaluation else None,
        **diagnostics,
        "seconds": seconds,
        "frames_per_second": frames / seconds,
    }
