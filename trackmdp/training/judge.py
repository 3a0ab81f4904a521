"""Where a policy stands: its exact figures, Q_MDP's, the bounds, and the distance to the best of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from trackmdp.solvers import bounds, qmdp
from trackmdp.solvers.chains import Evaluation, evaluate, regret_per_step
from trackmdp.world.model import BoolArray, World

__all__ = ["Judge", "Verdict", "figures"]

_PER_CELL = ("value", "steps", "detections", "sensors", "safe_actions")


@dataclass(frozen=True)
class Verdict:
    """A policy's exact figures and its regret per step to the best upper bound known."""

    evaluation: Evaluation
    regret_per_step: float


class Judge:
    """Scores learned, fixed and solved policies alike, by their chains."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.bounds = {
            "paper": float(bounds.paper(world).mean()),
            "valid": float(bounds.valid(world).mean()),
            "clocked": float(bounds.clocked(world).mean()),
        }
        self.upper = self.bounds["clocked"]
        self.qmdp = evaluate(world, qmdp.solve(world))

    def score(self, chains: BoolArray) -> Verdict:
        """Exact figures of the policy with these `chains` `[M, t_max+1, M]`."""
        evaluation = evaluate(self.world, chains)
        return Verdict(evaluation, regret_per_step(self.upper, evaluation))


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """The single figures of an evaluation, as they stand in `summary.json`."""
    return {key: value for key, value in asdict(evaluation).items() if key not in _PER_CELL}
