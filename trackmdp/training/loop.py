"""The training loop; it names no algorithm."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector

from trackmdp.algos.common import Algorithm
from trackmdp.errors import Preempted, RunError
from trackmdp.training.display import Display
from trackmdp.training.evaluate import chains_of
from trackmdp.training.evaluator import Evaluator, Score, while_collecting
from trackmdp.training.metrics import MetricsLog
from trackmdp.training.signals import Signals
from trackmdp.training.workers import Watch
from trackmdp.world.model import BoolArray

__all__ = ["Intervals", "Position", "train"]

_SAVING = 50  # seconds of training to one of saving, at least


@dataclass(frozen=True)
class Intervals:
    """How often a run is evaluated, logged and saved.

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
    """How far a run is: iterations done, frames collected, seconds spent, and the sum of the frames' rewards."""

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0
    reward: float = 0.0


def train(
    algorithm: Algorithm,
    collector: BaseCollector,
    evaluator: Evaluator,
    metrics: MetricsLog,
    display: Display,
    every: Intervals,
    save: Callable[[Position, Score], None],
    start: Position,
    on_evaluation: Callable[[int, BoolArray], None] | None = None,
) -> tuple[Score, Position]:
    """Collect, learn, evaluate, log and save, until the algorithm's iterations are done.

    Args:
        algorithm: learns from each batch; its `actor` is evaluated.
        collector: yields batches `[B, time]` until its frames are spent.
        evaluator: figures of the actor's chains.
        metrics: gets one row every `every.log` iterations, and the last.
        display: gets the figures of the last evaluation after each iteration.
        every: the intervals.
        save: writes a checkpoint of this moment, a boundary between two iterations.
        start: where an earlier process left the run.
        on_evaluation: called with the iteration and the chains of each policy evaluated.

    Returns:
        The last score and position.

    Raises:
        Preempted: a signal asked for the end; a checkpoint has been saved.
        RunError: the loss is not finite, or collecting broke down; the last checkpoint stands.
    """
    return _Loop(algorithm, collector, evaluator, metrics, display, every, save, start, on_evaluation).run()


@dataclass
class _Loop:
    """What `train` is given, and how far it is."""

    algorithm: Algorithm
    collector: BaseCollector
    evaluator: Evaluator
    metrics: MetricsLog
    display: Display
    every: Intervals
    save: Callable[[Position, Score], None]
    at: Position
    on_evaluation: Callable[[int, BoolArray], None] | None

    def run(self) -> tuple[Score, Position]:
        began, last = time.monotonic() - self.at.seconds, self.algorithm.iterations
        self._batches, self._saved, self._rest = iter(self.collector), self.at, 0.0
        self._score = self.evaluator.score(self._chains())
        with Signals() as self._signals, Watch(self.collector) as self._watch:
            for iteration in range(self.at.iteration + 1, last + 1):
                batch = self._collect(iteration)
                frames, earned = (0, 0.0) if batch is None else (batch.numel(), batch["next", "reward"].sum().item())
                diagnostics = self._learn(batch, iteration)
                before, elapsed = self.at, time.monotonic() - began
                self.at = Position(iteration, before.frames + frames, elapsed, before.reward + earned)
                self._account(diagnostics, earned / frames if frames else None)
                if self._signals.received and iteration < last:
                    raise Preempted(self._signals.received)
        return self._score, replace(self.at, seconds=time.monotonic() - began)

    def _collect(self, iteration: int) -> TensorDictBase | None:
        """The next batch, None once all frames are in."""
        try:
            with _named(iteration), self._watch.waiting():
                return next(self._batches, None)
        except RunError:
            if not self._signals.received:
                raise
            self.save(self.at, self._score)  # the signal went to the workers too; nothing has been learned since
            raise Preempted(self._signals.received) from None

    def _learn(self, batch: TensorDictBase | None, iteration: int) -> dict[str, float]:
        """One iteration of learning, after which the collector has the new weights."""
        try:
            diagnostics = self.algorithm.step(batch)
        except FloatingPointError as error:
            raise RunError(f"iteration {iteration}: {error}; the last checkpoint holds a good state") from error
        if batch is not None:
            with _named(iteration), self._watch.waiting():
                self.collector.update_policy_weights_()
        return diagnostics

    def _account(self, diagnostics: dict[str, float], earned: float | None) -> None:
        """Evaluate, log, save and show what is due after an iteration; `earned`: mean reward of its batch, if any."""
        at, every = self.at, self.every
        last = at.iteration == self.algorithm.iterations
        due = last or at.iteration == 1 or at.iteration % every.evaluate == 0
        if due:
            chains = self._chains()
            self._score = self.evaluator.score(chains)
            if self.on_evaluation is not None:
                self.on_evaluation(at.iteration, chains)
        if last or at.iteration % every.log == 0:
            so_far = while_collecting(self.evaluator.upper, self._score.evaluation, at.reward, at.frames)
            spent = {"reward_per_frame": earned, "regret_while_collecting": so_far["regret_per_frame"]}
            self.metrics.write(_row(at, self._score if due else None, spent | diagnostics))
        if last or self._signals.received or _due(self._saved, at, self._rest, every):
            begin = time.monotonic()
            self.save(at, self._score)
            self._saved, self._rest = at, _SAVING * (time.monotonic() - begin)
        aihtr = self._score.evaluation.aihtr
        self.display.update(at.iteration, at.frames, aihtr, self.evaluator.upper - aihtr)

    def _chains(self) -> BoolArray:
        return chains_of(self.algorithm.actor, self.evaluator.world, self.algorithm.device)


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


def _row(at: Position, score: Score | None, diagnostics: Mapping[str, float | None]) -> dict[str, float | int | None]:
    """Counters, exact figures (empty between evaluations), diagnostics, and last the columns that time decides."""
    evaluation = score.evaluation if score else None
    return {
        "iteration": at.iteration,
        "frames": at.frames,
        "aihtr": evaluation.aihtr if evaluation else None,
        "regret_per_step": score.regret_per_step if score else None,
        "accuracy": evaluation.accuracy if evaluation else None,
        "sensors_per_step": evaluation.sensors_per_step if evaluation else None,
        **diagnostics,
        "seconds": at.seconds,
        "frames_per_second": at.frames / at.seconds,
    }
