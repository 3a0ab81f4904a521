"""The log of episodes as a part of training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trackmdp.config import McapConfig
from trackmdp.config.resume import config_text
from trackmdp.episodes.log import EpisodeLog
from trackmdp.policies.policy import Policy
from trackmdp.training.callbacks import Callback, Training
from trackmdp.training.evaluator import Score
from trackmdp.world.model import World

__all__ = ["EpisodeLogger"]


class EpisodeLogger(Callback):
    """`episodes.mcap`: episodes of the policy at the first evaluation, at every k-th one, and at the last.

    Args:
        cfg: how many episodes of which evaluations.
        folder: of the run.
    """

    name = "episodes"

    def __init__(self, cfg: McapConfig, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder
        self._policies: int | None = None

    def on_start(self, trainer: Training) -> None:
        """Open the log; what an earlier process recorded after its last checkpoint is cut off."""
        assert isinstance(trainer.problem, World)
        self._log = EpisodeLog(
            self._folder,
            trainer.problem,
            seed=trainer.config.seed,
            config=config_text(trainer.config),
            layout=self._cfg.layout,
            policies=self._policies,
            command="train",
        )

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:  # noqa: ARG002
        """Record episodes of this policy where they are due."""
        iteration, every = trainer.position.iteration, trainer.config.evaluation.every * self._cfg.evaluations
        if iteration == 1 or trainer.due(every):
            facts = {"label": f"iteration {iteration}"}
            self._log.record(policy, facts, self._cfg.episodes, iteration)

    def on_end(self, trainer: Training) -> None:  # noqa: ARG002
        """Finish the file."""
        self._log.close()

    def state_dict(self) -> dict[str, Any]:
        """How many policies were recorded."""
        return {"policies": self._log.policies}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume the log after the policies it held when the state was taken."""
        self._policies = state["policies"]
