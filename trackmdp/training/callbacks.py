"""Callbacks of a training run: its logs, checkpoints and display are made of them, and users may add their own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

if TYPE_CHECKING:  # the display of a planner is no reason to load torch
    import torch
    from tensordict import TensorDictBase
    from torchrl.collectors import BaseCollector

    from trackmdp.algos.common import Algorithm
    from trackmdp.config import TrainConfig
    from trackmdp.policies.policy import Policy
    from trackmdp.training.evaluator import Evaluator, Score
    from trackmdp.world.group import Subject

Row = Mapping[str, float | int | None]
"""Figures of one iteration by their names, as `metrics.csv` has them; None for missing figures."""


@dataclass(frozen=True)
class Position:
    """How far a run is: iterations done, frames collected, seconds spent, and the sum of the frames' rewards."""

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0
    reward: float = 0.0


class Learning:
    """A run that learns, of the whole grid or by blocks.

    Args:
        problem: the world, recorded tracks, or several targets. A learner is given its task alone.
        config: the checked config of `trackmdp train`.
        folder: of the run's files; None to write nothing.
        console: where progress is shown; None for nowhere.

    Attributes:
        evaluator: gives figures of policies, and upper bounds. From the start of `run` on.
        callbacks: called during the run.
        start: where an earlier process left the run.
        position: how far the run is.
    """

    evaluator: Evaluator

    def __init__(
        self, problem: Subject, config: TrainConfig, folder: Path | None, console: Console | None
    ) -> None:
        self.problem, self.config, self.folder = problem, config, folder
        self.console = console or Console(quiet=True)
        self.callbacks: list[Callback] = []
        self.start, self.position = Position(), Position()

    def run(self) -> Score:
        """Learn to the end; the score of the last policy."""
        raise NotImplementedError

    def policy(self) -> Policy:
        """The policy as it is now."""
        raise NotImplementedError


class Training(Learning):
    """The run as callbacks may read it: the trainer, `trackmdp.training.trainer.Trainer`, which describes each."""

    device: torch.device
    algorithm: Algorithm
    collector: BaseCollector
    collecting: float
    score: Score
    error: BaseException | None = None

    @property
    def iterations(self) -> int:
        """Iterations of the whole run."""
        return self.algorithm.iterations

    @property
    def evaluates(self) -> bool:
        """Whether the policy of this iteration is evaluated, so that `score` is its own."""
        return self.position.iteration == 1 or self.due(self.config.evaluation.every)

    def due(self, every: int) -> bool:
        """Whether this iteration is a multiple of `every`, or the last one."""
        return self.position.iteration == self.iterations or self.position.iteration % every == 0


class Callback:
    """Base of all callbacks: every hook does nothing.

    In an iteration the hooks are called in the order `on_batch` (learning follows), `on_evaluation` where an
    evaluation is due, `on_update`, `on_checkpoint` where one was saved. The callbacks are called in the order in which
    the trainer has them. A hook may read everything of the trainer; to change the run is at its own risk.
    """

    name = ""
    """Under this name the callback's state stands in a checkpoint; "" for a callback without state."""

    def on_start(self, trainer: Training) -> None:
        """Everything is built, and a resumed run put back where it was; the first batch comes next."""

    def on_batch(self, trainer: Training, batch: TensorDictBase) -> None:
        """A batch `[B, time]` was collected; it is learned from next."""

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:
        """The policy learned so far was evaluated."""

    def on_update(self, trainer: Training, row: Row) -> None:
        """An iteration is over: learned, evaluated where that was due, `trainer.position` moved on."""

    def on_checkpoint(self, trainer: Training, file: Path) -> None:
        """A checkpoint was saved."""

    def on_end(self, trainer: Training) -> None:
        """The run is over, however it ended: `trainer.error` is None where all iterations are done.

        Called in reverse order, once for every callback after its `on_start`.
        """

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values that a resumed run hands to `load_state_dict`."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`; called before `on_start`."""
