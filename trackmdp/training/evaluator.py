"""How good a policy is: its exact figures, the bounds, Q_MDP's figures, and its regret to the best bound."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation, regret_per_step
from trackmdp.world.model import Task, World

__all__ = ["Evaluator", "ExactEvaluator", "Score", "figures", "while_collecting"]

_PER_CELL = ("value", "steps", "detections", "sensors", "safe_actions")


@dataclass(frozen=True)
class Score:
    """A policy's figures and its regret per step to the best upper bound known, nan where there is none."""

    evaluation: Evaluation
    regret_per_step: float


class Evaluator(ABC):
    """Scores learned, fixed and solved policies alike.

    Attributes:
        world: where policies are evaluated.
        upper: the best upper bound known on the AIHTR; nan where there is none.
        bounds: the upper bounds by name, None where the setting has no such bound.
        qmdp: figures of the Q_MDP policy; None where there is no motion model to plan with.
    """

    world: Task
    upper: float
    bounds: dict[str, float | None]
    qmdp: Evaluation | None

    @abstractmethod
    def evaluate(self, policy: PolicyTable) -> Evaluation:
        """Figures of a policy."""

    def score(self, policy: PolicyTable) -> Score:
        """Figures and the regret per step, by which a policy may be chosen: while learning, for best.pt."""
        evaluation = self.evaluate(policy)
        return Score(evaluation, regret_per_step(self.upper, evaluation))

    def report(self, policy: PolicyTable) -> dict[str, Any] | None:  # noqa: ARG002
        """Figures with confidence intervals beside those of the references; None where all figures are exact."""
        return None

    def tighten(self, upper: float, score: Score) -> Score:
        """Take a proved upper bound into account, from now on and in `score`."""
        self.upper = min(self.upper, upper)
        return Score(score.evaluation, regret_per_step(self.upper, score.evaluation))


class ExactEvaluator(Evaluator):
    """Evaluates with the motion model.

    Args:
        world: the task and the motion. The paper's bound knows no `max_steps` and is None where the world has one.
    """

    world: World
    qmdp: Evaluation

    def __init__(self, world: World) -> None:
        self.world = world
        paper = None if world.max_steps is not None else float(bounds.paper(world).mean())
        self.upper = float(bounds.clocked(world).mean())
        self.bounds = {"paper": paper, "valid": float(bounds.valid(world).mean()), "clocked": self.upper}
        self.qmdp = evaluate(world, qmdp.solve(world))

    def evaluate(self, policy: PolicyTable) -> Evaluation:
        """Exact figures of a policy."""
        return evaluate(self.world, policy)


def while_collecting(upper: float, evaluation: Evaluation, reward: float, frames: int) -> dict[str, float]:
    """What the frames of a run have earned on average, and how far that is below the best rate known.

    That rate is `upper` over the expected length of an episode, which no policy changes; `reward` is the frames' sum.
    """
    earned = reward / frames
    return {"reward_per_frame": earned, "regret_per_frame": upper / evaluation.expected_length - earned}


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """The single figures of an evaluation, as they stand in `summary.json`."""
    return {key: value for key, value in asdict(evaluation).items() if key not in _PER_CELL}
