"""Where a policy stands: its exact figures, Q_MDP's, the bounds, and the distance to the best of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from trackmdp.solvers import bounds, horizon, qmdp
from trackmdp.solvers.chains import Evaluation, evaluate, regret_per_step
from trackmdp.world.model import Task, World

__all__ = ["Judge", "Scoring", "Verdict", "figures", "while_collecting"]

_PER_CELL = ("value", "steps", "detections", "sensors", "safe_actions")


@dataclass(frozen=True)
class Verdict:
    """A policy's figures and its regret per step to the best upper bound known, nan where there is none."""

    evaluation: Evaluation
    regret_per_step: float


class Scoring(Protocol):
    """What training asks of a judge."""

    upper: float
    """The best upper bound known on the AIHTR; nan where there is none."""

    @property
    def world(self) -> Task:
        """Where policies are judged."""
        ...

    def score(self, chains: npt.NDArray[np.generic]) -> Verdict:
        """Where the policy with these `chains` `[M, t_max+1, M]` stands."""
        ...


class Judge:
    """Scores learned, fixed and solved policies alike, by their chains.

    Args:
        world: the task and the motion.
        max_steps: episodes are cut after this many steps, and so are all figures; None for never. The paper's bound
            knows no such limit and is None then.
    """

    def __init__(self, world: World, max_steps: int | None = None) -> None:
        self.world, self.max_steps = world, max_steps
        self.bounds: dict[str, float | None]
        if max_steps is None:
            self.bounds = {
                "paper": float(bounds.paper(world).mean()),
                "valid": float(bounds.valid(world).mean()),
            }
            self.upper = float(bounds.clocked(world).mean())
        else:
            self.bounds = {"paper": None, "valid": float(horizon.valid(world, max_steps).mean())}
            self.upper = float(horizon.clocked(world, max_steps).mean())
        self.bounds["clocked"] = self.upper
        self.qmdp = self.evaluate(qmdp.solve(world))

    def evaluate(self, chains: npt.NDArray[np.generic]) -> Evaluation:
        """Exact figures of the policy with these `chains` `[M, t_max+1, M]`."""
        if self.max_steps is None:
            return evaluate(self.world, chains)
        return horizon.evaluate(self.world, chains, self.max_steps)

    def score(self, chains: npt.NDArray[np.generic]) -> Verdict:
        """Exact figures and the regret per step."""
        evaluation = self.evaluate(chains)
        return Verdict(evaluation, regret_per_step(self.upper, evaluation))

    def tighten(self, upper: float, verdict: Verdict) -> Verdict:
        """Take a proved upper bound into account, from now on and in `verdict`."""
        self.upper = min(self.upper, upper)
        return Verdict(verdict.evaluation, regret_per_step(self.upper, verdict.evaluation))


def while_collecting(upper: float, evaluation: Evaluation, reward: float, frames: int) -> dict[str, float]:
    """What the frames of a run have earned on average, and how far that is below the best rate known.

    That rate is `upper` over the expected length of an episode, which no policy changes; `reward` is the frames' sum.
    """
    earned = reward / frames
    return {"reward_per_frame": earned, "regret_per_frame": upper / evaluation.expected_length - earned}


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """The single figures of an evaluation, as they stand in `summary.json`."""
    return {key: value for key, value in asdict(evaluation).items() if key not in _PER_CELL}
