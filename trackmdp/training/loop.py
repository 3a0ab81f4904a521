"""The training loop; it names no algorithm."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector

from trackmdp.algos.common import Algorithm
from trackmdp.errors import Preempted, RunError
from trackmdp.training.display import Display
from trackmdp.training.evaluate import chains_of
from trackmdp.training.judge import Judge, Verdict
from trackmdp.training.metrics import MetricsLog
from trackmdp.training.signals import Signals
from trackmdp.training.workers import Watch
from trackmdp.world.model import BoolArray

__all__ = ["Intervals", "Position", "train"]

_SAVING = 50  # seconds of training to one of saving, at least


@dataclass(frozen=True)
class Intervals:
    """How often a run is judged, logged and saved.

    Attributes:
        evaluate: iterations from one exact evaluation to the next.
        log: iterations from one metrics row to the next.
        save_frames: frames from one checkpoint to the next; 0 for none.
        save_seconds: seconds from one checkpoint to the next, more where saving takes long; None for none.
    """

    evaluate: int
    log: int
    save_frames: int
    save_seconds: float | None


@dataclass(frozen=True)
class Position:
    """How far a run is: iterations done, frames collected, seconds spent."""

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0


def train(
    algorithm: Algorithm,
    collector: BaseCollector,
    judge: Judge,
    metrics: MetricsLog,
    display: Display,
    every: Intervals,
    save: Callable[[Position, Verdict], None],
    start: Position,
    on_judged: Callable[[int, BoolArray], None] | None = None,
) -> tuple[Verdict, Position]:
    """Collect, learn, judge, log and save, until the algorithm's iterations are done.

    Args:
        algorithm: learns from each batch; its `actor` is judged.
        collector: yields batches `[B, time]` until its frames are spent.
        judge: exact figures of the actor's chains.
        metrics: gets one row every `every.log` iterations, and the last.
        display: gets the figures of the last evaluation after each iteration.
        every: the intervals.
        save: writes a checkpoint of this moment, a boundary between two iterations.
        start: where an earlier process left the run.
        on_judged: called with the iteration and the chains of each policy judged.

    Returns:
        The last verdict and position.

    Raises:
        Preempted: a signal asked for the end; a checkpoint has been saved.
        RunError: the loss is not finite, or collecting broke down; the last checkpoint stands.
    """
    began, batches = time.monotonic() - start.seconds, iter(collector)
    saved, at, rest = start, start, 0.0
    verdict = judge.score(chains_of(algorithm.actor, judge.world, algorithm.device))
    with Signals() as signals, Watch(collector) as watch:
        for iteration in range(start.iteration + 1, algorithm.iterations + 1):
            try:
                batch = _next(batches, watch, iteration)
            except RunError:
                if not signals.received:
                    raise
                save(at, verdict)  # the signal went to the workers as well, and nothing has been learned since
                raise Preempted(signals.received) from None
            try:
                diagnostics = algorithm.step(batch)
            except FloatingPointError as error:
                raise RunError(f"iteration {iteration}: {error}; the last checkpoint holds a good state") from error
            if batch is not None:
                _hand_over(collector, watch, iteration)
            frames = at.frames + (batch.numel() if batch is not None else 0)
            at = Position(iteration, frames, time.monotonic() - began)
            last = iteration == algorithm.iterations
            judged = last or iteration == 1 or iteration % every.evaluate == 0
            if judged:
                chains = chains_of(algorithm.actor, judge.world, algorithm.device)
                verdict = judge.score(chains)
                if on_judged is not None:
                    on_judged(iteration, chains)
            if last or iteration % every.log == 0:
                metrics.write(_row(at, verdict if judged else None, diagnostics))
            if last or signals.received or _due(saved, at, rest, every):
                begin = time.monotonic()
                save(at, verdict)
                saved, rest = at, _SAVING * (time.monotonic() - begin)
            display.update(iteration, frames, verdict.evaluation.aihtr, judge.upper - verdict.evaluation.aihtr)
            if signals.received and not last:
                raise Preempted(signals.received)
    return verdict, replace(at, seconds=time.monotonic() - began)


def _next(batches: Iterator[TensorDictBase], watch: Watch, iteration: int) -> TensorDictBase | None:
    with _named(iteration), watch.waiting():
        return next(batches, None)


def _hand_over(collector: BaseCollector, watch: Watch, iteration: int) -> None:
    """Collect with the new weights from now on."""
    with _named(iteration), watch.waiting():
        collector.update_policy_weights_()


@contextmanager
def _named(iteration: int) -> Iterator[None]:
    """Where and why collecting broke down."""
    try:
        yield
    except (RuntimeError, OSError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RunError(
            f"iteration {iteration}: collecting broke down ({reason}); resume=auto goes on from the last checkpoint"
        ) from error


def _due(saved: Position, at: Position, rest: float, every: Intervals) -> bool:
    """Whether to save at `at`; by time not before `rest` seconds, or saving would take too much of it."""
    frames = every.save_frames and at.frames // every.save_frames > saved.frames // every.save_frames
    seconds = every.save_seconds is not None and at.seconds - saved.seconds >= max(every.save_seconds, rest)
    return bool(frames or seconds)


def _row(at: Position, verdict: Verdict | None, diagnostics: dict[str, float]) -> dict[str, float | int | None]:
    """Counters, exact figures (empty between evaluations), diagnostics, and last the columns that time decides."""
    evaluation = verdict.evaluation if verdict else None
    return {
        "iteration": at.iteration,
        "frames": at.frames,
        "aihtr": evaluation.aihtr if evaluation else None,
        "regret_per_step": verdict.regret_per_step if verdict else None,
        "accuracy": evaluation.accuracy if evaluation else None,
        "sensors_per_step": evaluation.sensors_per_step if evaluation else None,
        **diagnostics,
        "seconds": at.seconds,
        "frames_per_second": at.frames / at.seconds,
    }
