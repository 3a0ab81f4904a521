"""How good a policy is: exact figures, bounds and the regret to the best; or how it does on tracks no learner saw."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

from scipy import sparse

from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.estimates.path_plans import choose_plan
from trackmdp.config.registry import choice_values
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.sensing.task import Task
from trackmdp.solvers import bounds, rules
from trackmdp.solvers.evaluation import Evaluation, ReplayedTracks, regret_per_step
from trackmdp.solvers.hidden import averaged
from trackmdp.solvers.value import replay, value_of
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

ESTIMATED = "Q_MDP of the estimated kernel"
"""Q_MDP for the motion as the tracks to learn from show it."""
CELL_ALONE = "task.memory=cell"
"""The best policy found for those tracks that remembers the cell alone."""


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
        low, high = (
            f"{round(end, 4) + 0.0:.4f}"
            for end in (self.regret_per_step_lower, self.regret_per_step)
        )
        if high <= low or math.isnan(self.regret_per_step):
            return f"regret per step {high} to the upper bound"
        if self.regret_per_step_lower <= 0.0:
            return f"regret per step {high} to the upper bound; no better policy is known"
        return f"regret per step {low} to the best policy known, {high} to the upper bound"


class Evaluator:
    """Scores learned, fixed and solved policies alike.

    Attributes:
        world: where policies are evaluated.
        upper: the best upper bound known on the AIHTR; nan where there is none.
        lower: the AIHTR of the best policy known; nan where there is no bound.
        bounds: the upper bounds by name, None where the setting has no such bound.
        qmdp: figures of the Q_MDP policy; None where there is no motion model to plan with.
    """

    def __init__(self, world: Problem) -> None:
        self.world = world
        self.qmdp: Evaluation | None = None
        self.upper = self.lower = math.nan
        self.bounds: dict[str, float | None] = dict.fromkeys(("paper", "valid", "clocked"))

    def evaluate(self, policy: PolicyTable) -> Evaluation:
        """Figures of a policy: exact, or those on the held-out tracks."""
        return value_of(self.world, policy)

    def score(self, policy: PolicyTable) -> Score:
        """Figures and the regret per step, by which a policy may be chosen: while learning, for best.pt."""
        return self._score(self.evaluate(policy))

    def _score(self, evaluation: Evaluation) -> Score:
        best = max(self.lower, evaluation.aihtr) if not math.isnan(self.lower) else math.nan
        return Score(
            evaluation, regret_per_step(self.upper, evaluation), regret_per_step(best, evaluation)
        )

    def held_out(self, policy: PolicyTable) -> dict[str, Any] | None:  # noqa: ARG002
        """Figures with confidence intervals beside those of the references; None where all figures are exact."""
        return None

    def tighten(self, lower: float, upper: float, score: Score) -> Score:
        """Take the AIHTR of another policy and a proved bound into account, from now on and in `score`."""
        self.lower, self.upper = max(self.lower, lower), min(self.upper, upper)
        return self._score(score.evaluation)


class ExactEvaluator(Evaluator):
    """Evaluates with the motion model.

    Where modes are hidden the bounds know them, and Q_MDP plans with cells alone.

    Args:
        world: the task and the motion. The paper's bound knows no `max_steps` and is None where the world has one.
    """

    qmdp: Evaluation

    def __init__(self, world: World) -> None:
        super().__init__(world)
        if world.max_steps is None:
            self.bounds["paper"] = float(bounds.paper(world).mean())
        self.bounds["valid"] = float(bounds.valid(world).mean())
        self.upper = self.bounds["clocked"] = float(bounds.clocked(world).mean())
        self.qmdp = value_of(world, rules.qmdp(averaged(world)))
        self.lower = self.qmdp.aihtr


class HeldOutEvaluator(Evaluator):
    """Evaluates on every held-out track, from its first cell to its end; scores are those of the validation tracks.

    Every figure used while learning, or to choose between policies, is a score: the best of many policies on the
    held-out tracks would be the luckiest there. Without a motion model there are no bounds, no Q_MDP and no regret:
    `upper` and the scores' regrets are nan.

    Args:
        world: the task and its recorded tracks, each truncated after `max_steps` steps.
    """

    world: Recorded

    def __init__(self, world: Recorded) -> None:
        super().__init__(world)
        self.tracks = world.held_out.limited(world.max_steps)

    def score(self, policy: PolicyTable) -> Score:
        """Figures of a policy on the validation tracks."""
        return Score(value_of(self.world.selection, policy), math.nan, math.nan)

    def replayed(self, policy: PolicyTable) -> ReplayedTracks:
        """The totals of a policy on the held-out tracks."""
        return replay(self.world, self.tracks, policy)

    @cached_property
    def references(self) -> dict[str, PolicyTable]:
        """The policies that a learned one is compared with, by their names in tables."""
        task = self.world
        found: dict[str, PolicyTable] = {}
        # Only a policy that remembers more is compared with it.
        if task.keyed:
            own = choice_values("algo", "model_based")
            found[CELL_ALONE] = choose_plan(
                task.remembering(),
                task.tracks,
                judge=task.validation,
                discount=own["gamma"],
                rounds=own["rounds"],
            ).policy
        return found | fixed_policies(task) | {ESTIMATED: estimated_qmdp(task)}

    def held_out(self, policy: PolicyTable) -> dict[str, Any]:
        """The report on a policy: its figures on the held-out tracks beside the references'."""
        figures = {}
        for name, each in {"policy": policy, **self.references}.items():
            found = self.replayed(each).intervals(self.tracks.names)
            figures[name] = {key: asdict(interval) for key, interval in found.items()}
        return {
            "learned_from": len(self.world.tracks),
            "validation": len(self.world.validation),
            "tracks": len(self.tracks),
            "figures": figures,
        }


def fixed_policies(task: Task) -> dict[str, PolicyTable]:
    """All sensors on, where the budget allows it, and none."""
    all_on = {} if task.limited else {"all on": PolicyTable.all_on(task)}
    return all_on | {"no sensors": PolicyTable.none(task)}


def estimated_qmdp(task: Recorded) -> PolicyTable:
    """Q_MDP of the kernel estimated from the tracks to learn from."""
    kernel = estimated_kernel(task.tracks, task.size)
    return rules.qmdp(World.of(task, kernel, max_steps=None, memory="cell"))


def estimated_kernel(tracks: Tracks, size: tuple[int, int]) -> sparse.csr_array:
    """`[M, M]` the motion as `tracks` show it: posterior mean, the prior of a row counting as one move."""
    estimate = KernelEstimate(size, weight=1.0, exit_weight=1.0)
    estimate.add_moves(*tracks.steps(estimate.num_cells))
    # `[M, M + 1]`, the last column being the exit, which a kernel `[M, M]` leaves to its rows' missing mass.
    return estimate.mean()[:, :-1]


def while_collecting(
    upper: float, evaluation: Evaluation, reward: float, frames: int
) -> dict[str, float]:
    """The mean reward of a run's frames, and its distance to the best rate known.

    That rate is `upper` over the expected length of an episode, which no policy changes; `reward` is the frames' sum.
    """
    earned = reward / frames
    return {
        "reward_per_frame": earned,
        "regret_per_frame": upper / evaluation.expected_length - earned,
    }
