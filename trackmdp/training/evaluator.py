"""How good a policy is: its exact figures, the bounds, Q_MDP's figures, and its regret to the best bound."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation, regret_per_step
from trackmdp.solvers.keyed import averaged
from trackmdp.solvers.keyed_search import mode_bound
from trackmdp.world.model import Task
from trackmdp.world.modes import HiddenWorld, Modelled

_PER_CELL = ("value", "steps", "detections", "sensors", "safe_actions")


@dataclass(frozen=True)
class Score:
    """A policy's figures and its regret per step, nan where no bound is known.

    The regret to the optimum lies between the two regrets; where the optimum is certified, they are one.

    Attributes:
        evaluation: the figures.
        regret_per_step: regret to the best upper bound known.
        regret_per_step_lower: regret to the best policy known, which may be this one: never below 0.
    """

    evaluation: Evaluation
    regret_per_step: float
    regret_per_step_lower: float

    @property
    def regret(self) -> str:
        """The regret as it is printed: one number, or the range where its ends differ in four digits."""
        # Adding 0.0 turns the -0.0 that rounding leaves into 0.0.
        low, high = (f"{round(end, 4) + 0.0:.4f}" for end in (self.regret_per_step_lower, self.regret_per_step))
        if high <= low or math.isnan(self.regret_per_step):
            return f"regret per step {high} to the upper bound"
        return f"regret per step {low} to the best policy known, {high} to the upper bound"


class Evaluator(ABC):
    """Scores learned, fixed and solved policies alike.

    Attributes:
        world: where policies are evaluated.
        upper: the best upper bound known on the AIHTR; nan where there is none.
        lower: the AIHTR of the best policy known; nan where there is no bound.
        bounds: the upper bounds by name, None where the setting has no such bound.
        qmdp: figures of the Q_MDP policy; None where there is no motion model to plan with.
    """

    world: Task
    upper: float
    lower: float
    bounds: dict[str, float | None]
    qmdp: Evaluation | None

    @abstractmethod
    def evaluate(self, policy: PolicyTable) -> Evaluation:
        """Figures of a policy."""

    def score(self, policy: PolicyTable) -> Score:
        """Figures and the regret per step, by which a policy may be chosen: while learning, for best.pt."""
        return self._score(self.evaluate(policy))

    def _score(self, evaluation: Evaluation) -> Score:
        best = max(self.lower, evaluation.aihtr) if not math.isnan(self.lower) else math.nan
        return Score(evaluation, regret_per_step(self.upper, evaluation), regret_per_step(best, evaluation))

    def report(self, policy: PolicyTable) -> dict[str, Any] | None:  # noqa: ARG002
        """Figures with confidence intervals beside those of the references; None where all figures are exact."""
        return None

    def tighten(self, lower: float, upper: float, score: Score) -> Score:
        """Take the AIHTR of another policy and a proved bound into account, from now on and in `score`."""
        self.lower, self.upper = max(self.lower, lower), min(self.upper, upper)
        return self._score(score.evaluation)


class ExactEvaluator(Evaluator):
    """Evaluates with the motion model.

    Where targets have a mode the bound knows it at all times, and Q_MDP plans with cells alone.

    Args:
        world: the task and the motion. The paper's bound knows no `max_steps` and is None where the world has one.
    """

    world: Modelled
    qmdp: Evaluation

    def __init__(self, world: Modelled) -> None:
        self.world = world
        self.bounds = dict.fromkeys(("paper", "valid", "clocked"))
        if isinstance(world, HiddenWorld):
            self.upper = float(mode_bound(world)[:, 0].mean())
            self.qmdp = evaluate(world, qmdp.solve(averaged(world)))
        else:
            if world.max_steps is None:
                self.bounds["paper"] = float(bounds.paper(world).mean())
            self.bounds["valid"], self.upper = float(bounds.valid(world).mean()), float(bounds.clocked(world).mean())
            self.qmdp = evaluate(world, qmdp.solve(world))
        self.bounds["clocked"], self.lower = self.upper, self.qmdp.aihtr

    def evaluate(self, policy: PolicyTable) -> Evaluation:
        """Exact figures of a policy."""
        return evaluate(self.world, policy, per_cell=False)


def while_collecting(upper: float, evaluation: Evaluation, reward: float, frames: int) -> dict[str, float]:
    """What the frames of a run have earned on average, and how far that is below the best rate known.

    That rate is `upper` over the expected length of an episode, which no policy changes; `reward` is the frames' sum.
    """
    earned = reward / frames
    return {"reward_per_frame": earned, "regret_per_frame": upper / evaluation.expected_length - earned}


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """The single figures of an evaluation, as they stand in `summary.json`."""
    return {key: value for key, value in asdict(evaluation).items() if key not in _PER_CELL}
