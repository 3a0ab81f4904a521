"""The training run: collect, learn, evaluate, log, save; it names no algorithm and no log."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from tensordict import TensorDictBase

from trackmdp.algos.common import make_algorithm
from trackmdp.config import TrainConfig
from trackmdp.durable import write_json
from trackmdp.errors import Preempted, RunError
from trackmdp.machine import make_device
from trackmdp.policies.policy import Policy
from trackmdp.seeding import seed_global
from trackmdp.signals import Signals, Watch
from trackmdp.training import checkpoint
from trackmdp.training.callbacks import Callback, Position, Row, Training
from trackmdp.training.collect import make_collector
from trackmdp.training.devices import check_memory
from trackmdp.training.display import Display
from trackmdp.training.evaluator import Score, while_collecting
from trackmdp.training.folders import SUMMARY
from trackmdp.training.group_run import evaluator_of, learned_policy
from trackmdp.training.inputs import with_own_classes, write_inputs
from trackmdp.training.loggers import make_loggers
from trackmdp.training.state import Checkpoints, find, restore, take_weights
from trackmdp.untrusted import decoded, reason
from trackmdp.world.group import Subject


class Trainer(Training):
    """One training run, begun anew or resumed from a checkpoint in its folder.

    Args:
        problem: see `Learning`, as for `config` and `console`.
        config: see there.
        folder: where inputs, logs and checkpoints are written; None to write nothing.
        callbacks: are called after the logs that the config names, before the checkpoints.
        console: see there.
        nets: `actor` and `critic` of the user's own, where the algorithm takes them.

    Attributes:
        algorithm: the learner; its `actor` is evaluated. From the start of `run` on, as the following ones.
        collector: yields batches `[B, time]` until the frames are spent.
        evaluator: gives figures of policies, and upper bounds.
        start: where an earlier process left the run.
        position: how far the run is.
        score: of the last evaluation.
        error: the reason of an early end, None otherwise.

    Raises:
        UserError: the config names something missing, or needs more memory than there is.
    """

    def __init__(
        self,
        problem: Subject,
        config: TrainConfig,
        *,
        folder: Path | None = None,
        callbacks: Sequence[Callback] = (),
        console: Console | None = None,
        nets: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(problem, config, folder, console)
        self._nets = nets
        self.device = make_device(config.device)
        # Order: logs, the user's callbacks, checkpoints, display. A checkpoint holds how far the logs are written, so
        # that they must have written this iteration's row before it is saved; the display shows it afterwards.
        self.callbacks = [*callbacks]
        if folder is not None:
            self.callbacks.append(Checkpoints(config.checkpoint, folder / "checkpoints"))
            self.callbacks[:0] = make_loggers(config, folder)
        self.callbacks.append(Display(self.console, f"{config.algo.name} seed {config.seed}"))
        self.console.print(check_memory(config, problem.task, self.device))

    def policy(self) -> Any:
        """The policy as it is now; asking for it does not disturb the run."""
        return learned_policy(self.problem, self.algorithm.actor, self.device)

    def run(self) -> Score:
        """Train to the end; returns the score of the last policy.

        Raises:
            UserError: the run in the folder is not the one that the config describes.
            Preempted: a signal asked for the end; a checkpoint has been saved.
            RunError: the loss is not finite, or collecting broke down; the last checkpoint stands.
        """
        began = time.monotonic()
        with ExitStack() as opened:
            self._build(opened)
            # Left last, after the callbacks' ends: a second signal must not cut off the saving that the first began.
            self._signals = opened.enter_context(Signals())
            # TorchRL keeps its workers as `procs`; a collector in this process, or on Ray, has none.
            self._watch = opened.enter_context(Watch(getattr(self.collector, "procs", ())))
            for callback in self.callbacks:
                callback.on_start(self)
                # Registered one by one: if the third callback cannot start, the first two are still ended, in reverse
                # order.
                opened.callback(callback.on_end, self)
            # As if the run had begun so much earlier: seconds go on counting where the earlier process stopped.
            self._began = time.monotonic() - self.start.seconds
            try:
                self._loop()
            except BaseException as error:
                # on_end is called after this, and reads it: only Preempted leaves a state that is worth saving.
                self.error = error
                raise
        self._check_signals()  # one may have come while the callbacks ended
        self.position = replace(
            self.position, seconds=time.monotonic() - began + self.start.seconds
        )
        return self.score

    def _build(self, opened: ExitStack) -> None:
        """Learner, collector and evaluator; put back from the checkpoint where the run is resumed."""
        config, problem, folder = self.config, self.problem, self.folder
        state: dict[str, Any] | None = None
        skipped: list[str] = []
        if folder is not None:
            state, skipped = find(config, problem, folder, self.device)
        for line in skipped:
            self.console.print(f"passed over: {line}")
        # Networks are initialised from torch's global generator, so that it is seeded before anything is built.
        seed_global(config.seed)
        own = config if state is None or folder is None else with_own_classes(config, folder)
        self.algorithm = make_algorithm(own, problem.task, self.device, self._nets, problem.targets)
        done = Position(**state["position"]).frames if state else 0
        self.collector = make_collector(
            config, problem, self.algorithm.policy, self.device, done=done
        )
        # At once, so that worker processes end as well if a later step raises (a damaged checkpoint).
        opened.callback(self.collector.shutdown)
        self.evaluator = evaluator_of(problem, config.seed)
        self.start = self._restore(state)
        self.position, self.collecting = self.start, 0.0
        if folder is not None:
            # A summary is of an older config, such as a smaller budget: with it this run would count as done.
            (folder / SUMMARY).unlink(missing_ok=True)
            checkpoint.remove_later(folder / "checkpoints", self.start.iteration)
            write_inputs(config, problem, folder, resumed=state is not None)
            plan = {
                "iterations": self.iterations,
                "upper_bound": self.evaluator.upper,
                "least": config.algo.plans_at_end,
            }
            write_json(folder / "plan.json", plan)  # for `watch`

    def _restore(self, state: dict[str, Any] | None) -> Position:
        """The position after the last checkpoint, or at the start, perhaps with the weights of another run."""
        if state is not None:
            for callback in self.callbacks:
                if callback.name in state["callbacks"]:
                    with decoded(state["file"], f"a state that fits {callback.name}"):
                        callback.load_state_dict(state["callbacks"][callback.name])
            with decoded(state["file"], "a state that fits this run"):
                start = restore(state, self.algorithm, self.collector)
            self.console.print(
                f"resumes after iteration {start.iteration}, {start.frames:,} frames"
            )
            return start
        if self.config.init_from is not None:
            taken = take_weights(self.algorithm, Path(self.config.init_from), self.device)
            self.console.print(f"weights from {self.config.init_from}: {', '.join(taken)}")
        return Position()

    def _loop(self) -> None:
        self._batches = iter(self.collector)
        # Before any learning: rows between evaluations and the display use the last score, and there must be one.
        self._valued: tuple[object, Policy] | None = None
        self._revalue()
        for iteration in range(self.position.iteration + 1, self.iterations + 1):
            batch = self._collect(iteration)
            # Summed before learning: an algorithm may scale the rewards of its batch in place.
            frames, earned = (
                (0, 0.0) if batch is None else (batch.numel(), batch["next", "reward"].sum().item())
            )
            diagnostics = self._learn(batch, iteration)
            before, elapsed = self.position, time.monotonic() - self._began
            self.position = Position(
                iteration, before.frames + frames, elapsed, before.reward + earned
            )
            self._account(diagnostics, earned / frames if frames else None)
            self._check_signals()

    def _check_signals(self) -> None:
        if self._signals.received:
            raise Preempted(self._signals.received)

    def _collect(self, iteration: int) -> TensorDictBase | None:
        """The next batch, None once all frames are in."""
        # Where it is stopped, nothing has been learned since the last iteration, so that this is a state to save.
        with self._asking(iteration):
            began = time.monotonic()
            # None after the last batch: learners that replay have more iterations than batches.
            batch = next(self._batches, None)
            self.collecting += time.monotonic() - began
        if batch is not None:
            for callback in self.callbacks:
                callback.on_batch(self, batch)
        return batch

    def _learn(self, batch: TensorDictBase | None, iteration: int) -> dict[str, float]:
        """One iteration of learning, after which the collector has the new weights."""
        try:
            diagnostics = self.algorithm.step(batch)
        except FloatingPointError as error:
            raise RunError(
                f"iteration {iteration}: {error}; the last checkpoint holds a good state"
            ) from error
        if batch is not None:
            # Where it is stopped, the last update is counted and saved, and then the run ends: nobody needs these
            # weights, unless this was the last iteration, after which nobody does either.
            with suppress(Preempted), self._asking(iteration):
                self.collector.update_policy_weights_()
        return diagnostics

    @contextmanager
    def _asking(self, iteration: int) -> Iterator[None]:
        """Around a call of the collector.

        Raises:
            Preempted: it failed since a signal ended the workers too.
            RunError: it failed.
        """
        try:
            with self._watch.waiting():
                yield
        except (RuntimeError, OSError) as error:
            if self._signals.heard():
                raise Preempted(self._signals.received) from None
            why = f"collecting broke down ({reason(error)})"
            raise RunError(
                f"iteration {iteration}: {why}; resume=auto resumes from the last checkpoint"
            ) from error

    def _account(self, diagnostics: dict[str, float], earned: float | None) -> None:
        """Evaluate where that is due, and call the callbacks; `earned`: mean reward of the batch's frames, if any."""
        if self.evaluates:
            policy = self._revalue()
            for callback in self.callbacks:
                callback.on_evaluation(self, policy, self.score)
        row = self._row(diagnostics, earned)
        for callback in self.callbacks:
            callback.on_update(self, row)

    def _revalue(self) -> Policy:
        """The policy as it is now; `score` is then its own."""
        actor = self.algorithm.actor
        # A learner that plans now and then has one table as its actor in between, valued once; nets change in place.
        if self._valued is None or self._valued[0] is not actor or not isinstance(actor, Policy):
            self._valued = (actor, self.policy())
            self.score = self.evaluator.score(self._valued[1])
        return self._valued[1]

    def _row(self, diagnostics: dict[str, float], earned: float | None) -> Row:
        """Counters, exact figures (empty between evaluations), diagnostics, and last the columns that time decides."""
        at, evaluation = self.position, self.score.evaluation
        exact = {
            "aihtr": evaluation.aihtr,
            "regret_per_step": self.score.regret_per_step,
            "accuracy": evaluation.accuracy,
            "sensors_per_step": evaluation.sensors_per_step,
        }
        # No policy changes the expected length, but each rounds it otherwise; a fixed policy's is the same to the bit
        # wherever a run was cut and resumed.
        so_far = while_collecting(
            self.evaluator.upper, self.evaluator.qmdp or evaluation, at.reward, at.frames
        )
        return {
            "iteration": at.iteration,
            "frames": at.frames,
            **(exact if self.evaluates else dict.fromkeys(exact)),
            "reward_per_frame": earned,
            "regret_while_collecting": so_far["regret_per_frame"],
            **diagnostics,
            "seconds": at.seconds,
            "frames_per_second": at.frames / at.seconds,
        }
