"""When a run is saved."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trackmdp.config import CheckpointConfig
from trackmdp.errors import Preempted
from trackmdp.policies.policy import Policy
from trackmdp.training import checkpoint
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.training.evaluator import Score
from trackmdp.training.state import Position, capture

_SAVING = 50  # seconds of training to one of saving, at least


class Checkpoints(Callback):
    """Saves the run by frames and by time, at its end, and where a signal asks for its end.

    Args:
        cfg: how often, and how many checkpoints are kept.
        folder: of the checkpoints.
    """

    name = "checkpoints"

    def __init__(self, cfg: CheckpointConfig, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder
        self._best, self._rest = -math.inf, 0.0
        self._is_best = False
        self._evaluated: tuple[int, float] = (-1, -math.inf)

    def on_start(self, trainer: Training) -> None:
        """Intervals count from where the run is.

        The process that wrote the checkpoint may have been killed before last.pt and best.pt were the same file.
        """
        self._saved = trainer.position
        file = checkpoint.named(self._folder, trainer.position.iteration)
        if trainer.position.iteration and file.is_file():
            checkpoint.point(file, best=self._is_best)

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:  # noqa: ARG002
        """Remember what the policy of this iteration attains."""
        self._evaluated = trainer.position.iteration, score.evaluation.aihtr

    def on_update(self, trainer: Training, row: Row) -> None:  # noqa: ARG002
        """Save after the last iteration, and where it is due."""
        if self._is_planned(trainer) or self.due(trainer.position):
            self.save(trainer)

    def on_end(self, trainer: Training) -> None:
        """Save where a signal ended the run: that is the one error that leaves a state between two iterations."""
        if isinstance(trainer.error, Preempted) and trainer.position != self._saved:
            self.save(trainer)

    def due(self, at: Position) -> bool:
        """Whether to save at `at`.

        By time not before training took 50 times as long as the last saving, which would else take too much of it.
        """
        seconds = self._cfg.seconds is not None and at.seconds - self._saved.seconds >= max(
            self._cfg.seconds, self._rest
        )
        return self._passes_multiple(at) or seconds

    def _passes_multiple(self, at: Position) -> bool:
        # Multiples that were passed, since batches seldom end on one: every=30,000 with batches of 20,000 saves at
        # 40,000, 60,000 and 100,000.
        every = self._cfg.every
        return every > 0 and at.frames // every > self._saved.frames // every

    def _is_planned(self, trainer: Training) -> bool:
        """Whether this iteration is saved in every run of this config, cut or not."""
        return trainer.position.iteration == trainer.iterations or self._passes_multiple(trainer.position)

    def save(self, trainer: Training) -> None:
        """Save the run as it is, and tell the callbacks."""
        begin = time.monotonic()
        # Where checkpoints are counted in frames, one that a signal or the clock asked for is none of the candidates:
        # else which one is the best would depend on where the run was cut.
        aihtr = self._attained(trainer) if not self._cfg.every or self._is_planned(trainer) else -math.inf
        self._is_best, self._best = aihtr > self._best, max(self._best, aihtr)
        # `_best` and `_is_best` are part of the state, so they are set before it is taken. The logs are called before
        # this callback: the lengths of files in their states include this iteration's row and episodes.
        named = {each.name: each.state_dict() for each in trainer.callbacks if each.name}
        run = self._folder.parent
        state = capture(trainer.config, run, trainer.algorithm, trainer.collector, trainer.position, named)
        file = checkpoint.save(self._folder, trainer.position.iteration, state, keep=self._cfg.keep, best=self._is_best)
        # Measured, since saving a large replay buffer to a slow disk may take longer than the interval asked for.
        self._saved, self._rest = trainer.position, _SAVING * (time.monotonic() - begin)
        for callback in trainer.callbacks:
            callback.on_checkpoint(trainer, file)

    def _attained(self, trainer: Training) -> float:
        """AIHTR of the very policy that is saved.

        That of the last evaluation may be of an earlier policy, and of another one in a run that was resumed in
        between: best.pt would depend on where a run was cut.
        """
        iteration, aihtr = self._evaluated
        if iteration == trainer.position.iteration:
            return aihtr
        # Evaluating draws from no generator of the run, so that saving more often leaves the run as it is.
        return trainer.evaluator.score(trainer.policy()).evaluation.aihtr

    def state_dict(self) -> dict[str, Any]:
        """The highest AIHTR of the checkpoints that count, and whether it is this one's."""
        return {"best": self._best, "is_best": self._is_best}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._best, self._is_best = float(state["best"]), state["is_best"] is True
