"""Policies for several targets in a training run: figures while learning, and at the end beside the bracket."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict.nn import TensorDictModuleBase

from trackmdp.algos.common import make_algorithm
from trackmdp.config import TrainConfig
from trackmdp.config.roots import OptimalBoundConfig
from trackmdp.policies.policy import Policy
from trackmdp.recordings.tracks import Recorded
from trackmdp.seeding import derive, preserved_global_rng, single_precision
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation, regret_per_step
from trackmdp.solvers.several.group_bounds import upper_bound
from trackmdp.solvers.several.group_figures import GroupEvaluation, with_ends
from trackmdp.solvers.several.group_solution import GroupSolution
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.joint_rule import JointRule
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.solution import Solution
from trackmdp.training.evaluator import (
    Evaluator,
    ExactEvaluator,
    HeldOutEvaluator,
    Score,
    fixed_policies,
)
from trackmdp.world.group import Group, Subject

_SCORED = 32
"""Episodes by which a policy is scored while it learns: with corrected means (`GroupEvaluation.aihtr`) enough to see
it grow."""


class GroupEvaluator(Evaluator):
    """Scores policies that were learned of all targets together, on the same simulated targets each time.

    Args:
        group: the targets.
        seed: of the run; the targets are others than those of the final figures.
    """

    def __init__(self, group: Group, seed: int) -> None:
        super().__init__(group.kinds[0])
        self._seed, self._chosen_by = derive(seed, "scores"), group.selection
        self.upper = self.bounds["clocked"] = upper_bound(group)
        self.lower = -math.inf if group.recorded is None else math.nan

    def score(self, policy: Rule) -> Score:  # type: ignore[override]  # no table
        """Figures of `_SCORED` episodes, on recorded tracks of all groups of those to choose by."""
        rule = policy.within(self._chosen_by)
        return self._score(means(evaluate_group(rule, seed=self._seed, episodes=_SCORED)))


def evaluator_of(subject: Subject, seed: int) -> Evaluator:
    """Exact where there is a motion model, else on the held-out tracks; of several targets a `GroupEvaluator`."""
    if isinstance(subject, Group):
        return GroupEvaluator(subject, seed)
    return HeldOutEvaluator(subject) if isinstance(subject, Recorded) else ExactEvaluator(subject)


def learned_policy(
    subject: Subject, actor: TensorDictModuleBase, device: torch.device
) -> Policy | JointRule:
    """The table of a learner's actor, or of several targets the actor itself; a `Policy` is a table already."""
    if isinstance(subject, Group):
        return JointRule(subject, actor, device)
    if isinstance(actor, Policy):
        return actor
    # Learners evaluate a deterministic actor, so that there is no need to ask twice whether it draws.
    return Policy.from_module(subject.task, actor, device=device, check=False)


def joint_policy(
    cfg: TrainConfig, group: Group, arrays: Mapping[str, npt.NDArray[Any]]
) -> JointRule:
    """The policy of a run with these options and weights (`JointRule.packed`).

    Raises:
        RuntimeError, TypeError: the weights are of other networks, or no real numbers.
    """
    device = torch.device("cpu")
    with preserved_global_rng(), single_precision():
        algorithm = make_algorithm(cfg, group.task, device, targets=group.targets)
    # torch would take the real parts of complex weights, and warn.
    weights = {
        name: torch.from_numpy(part.astype(np.float32, casting="same_kind"))
        for name, part in arrays.items()
        if name != "targets"
    }
    actor: Any = algorithm.actor
    actor.load_state_dict(weights)
    return JointRule(group, actor, device)


def means(found: GroupEvaluation) -> Evaluation:
    """The means alone, in the form of the figures of a single target."""
    nothing = np.zeros(0)
    return Evaluation(
        aihtr=found.aihtr.mean,
        value=nothing,
        accuracy=found.accuracy.mean,
        sensors_per_step=found.sensors_per_step.mean,
        safe_per_episode=found.safe_per_step.mean * found.expected_length,
        expected_length=found.expected_length,
        steps=nothing,
        detections=None,
        sensors=None,
        safe_actions=None,
    )


@dataclass(frozen=True)
class Several:
    """A policy for several targets beside the merged optimum of single ones, and beside the bound.

    Attributes:
        group: the targets.
        merge: how single targets' plans were put together; joint for a policy that was learned of all.
        figures: of the policy.
        upper: proved: no policy has a higher AIHTR; nan on recorded tracks.
        solution: optima of single targets; None where they were not solved for.
        merged: figures of these, merged.
        fixed: figures of policies that need no learning, on recorded tracks.
    """

    group: Group
    merge: str
    figures: GroupEvaluation
    upper: float
    solution: GroupSolution | None
    merged: GroupEvaluation | None
    fixed: Mapping[str, GroupEvaluation] = field(default_factory=dict)

    @property
    def score(self) -> Score:
        """The means, and their regrets."""
        found = means(self.figures)
        known = [each.aihtr.mean for each in (self.figures, self.merged) if each is not None]
        best = math.nan if math.isnan(self.upper) else max(known)
        return Score(found, *(regret_per_step(end, found) for end in (self.upper, best)))

    def report(self) -> dict[str, Any]:
        """As `summary.json` has it."""
        solution = self.solution
        return {
            "targets": len(self.group),
            "merge": self.merge,
            **self.figures.report(),
            "merged_optimum": None if self.merged is None else self.merged.report()["figures"],
            "apart": None if solution is None else solution.apart,
            "lower": None if solution is None else solution.lower,
            "upper": self.upper,
        }

    def rows(self, name: str) -> list[list[str]]:
        """A line for each policy: name, AIHTR, reward per step, accuracy and sensors per step; and the bound."""
        policies = {name: self.figures, **self.fixed}
        if self.merged is not None:
            policies["merged optimum"] = self.merged
        rows = [
            [name, *(with_ends(found) for found in list(each.figures.values())[:4])]
            for name, each in policies.items()
        ]
        bounds = {} if math.isnan(self.upper) else {"upper bound": self.upper}
        if self.solution is not None:
            bounds = {"separate trackers": self.solution.apart} | bounds
        length = self.figures.expected_length
        return rows + [
            [name, f"{aihtr:,.4f}", f"{aihtr / length:.4f}", "", ""]
            for name, aihtr in bounds.items()
        ]


def beside(
    rule: Rule, cfg: OptimalBoundConfig, *, width: float, seed: int, single: Solution | None
) -> Several:
    """The figures of a policy, and of the optima of single targets, merged.

    Args:
        rule: the policy.
        cfg: whether these optima are solved for, and for how long.
        width: half of the 95 % interval of the reward per step.
        seed: of the simulated targets.
        single: the optimum of a single target, where it is known.
    """
    group = rule.group
    figures, upper = evaluate_group(rule, width=width, seed=seed), upper_bound(group)
    found = partial(Several, group, rule.name, figures, upper)
    if group.recorded is not None:
        # Each target's sets together.
        policies = {} if group.task.limited else fixed_policies(group.single.task)
        fixed = {name: evaluate(group, policy) for name, policy in policies.items()}
        return found(None, None, fixed)
    if not cfg.enabled or group.task.max_steps is not None or group.hidden > 1:
        return found(None, None)
    solve = partial(optimal.solve, nodes=cfg.nodes, time_limit=cfg.time_limit)
    singles = (
        tuple(solve(kind).uninterrupted() for kind in group.kinds) if single is None else (single,)
    )
    solution = GroupSolution(group, singles, upper, sum(each.seconds for each in singles))
    return found(solution, evaluate_group(solution.policy, width=width, seed=seed))
