"""The log of episodes as a part of training."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trackmdp.config import McapConfig
from trackmdp.config.resume import config_text
from trackmdp.episodes.log import EpisodeLog
from trackmdp.policies.policy import Policy
from trackmdp.training.callbacks import Callback, Training
from trackmdp.training.evaluator import Score
from trackmdp.world.tracks import Recorded


class EpisodeLogger(Callback):
    """`episodes.mcap`: episodes of the policy at the first evaluation, at every k-th one, and at the last.

    Args:
        cfg: how many episodes of which evaluations.
        folder: of the run.
    """

    name = "episodes"

    def __init__(self, cfg: McapConfig, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder
        self._policies, self._lost = 0, ""

    def on_start(self, trainer: Training) -> None:
        """Open the log; what an earlier process recorded after its last checkpoint is cut off."""
        assert not isinstance(trainer.problem, Recorded)  # they are refused: there is no belief

        def tell(line: str) -> None:
            self._lost = line
            trainer.console.print(line, markup=False)

        self._log = EpisodeLog(
            self._folder,
            trainer.problem,
            seed=trainer.config.seed,
            config=config_text(trainer.config, trainer.folder),
            layout=self._cfg.layout,
            policies=self._policies or None,
            tell=tell,
        )

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:  # noqa: ARG002
        """Record episodes of this policy where they are due."""
        iteration, every = trainer.position.iteration, trainer.config.evaluation.every * self._cfg.evaluations
        if iteration == 1 or trainer.due(every):
            facts = {"label": f"iteration {iteration}"}
            self._log.record(policy, facts, self._cfg.episodes, iteration)
            # Also where logging is over: what a checkpoint holds must not depend on how full the disk was.
            self._policies += 1

    def on_end(self, trainer: Training) -> None:
        """Finish the file, and say what was lost of it; where the run itself broke down, its own line says why."""
        self._log.close()
        if self._lost and trainer.error is None:
            sys.stderr.write(f"trackmdp train: {self._lost}\n")

    def state_dict(self) -> dict[str, Any]:
        """How many policies were handed to the log, whose episodes are on the disk from then on."""
        self._log.sync()
        return {"policies": self._policies}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume the log after the policies it held when the state was taken."""
        self._policies = state["policies"]
