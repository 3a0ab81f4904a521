"""`tm.evaluate`: the figures of any policy, of one target or of several, with or without false alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.errors import UserError
from trackmdp.machine import torch_threads
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import value
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.false_alarms import believed
from trackmdp.solvers.several.group_figures import GroupEvaluation
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.merging import Rule, make_rule
from trackmdp.solvers.solve import named_policy
from trackmdp.world.group import Group, check_problem
from trackmdp.world.problem import Problem

if TYPE_CHECKING:  # torch is loaded where something that acts is asked for its sets
    from trackmdp.policies.policy import PolicyLike


@overload
def evaluate(
    problem: Problem, policy: PolicyLike | Array | BoolArray, *, false_alarm: float = ...
) -> Evaluation: ...
@overload
def evaluate(
    problem: Group,
    policy: PolicyLike,
    *,
    merge: str | None = ...,
    width: float = ...,
    seed: int = ...,
) -> GroupEvaluation: ...


def evaluate(
    problem: Problem | Group,
    policy: PolicyLike | Array | BoolArray,
    *,
    false_alarm: float = 0.0,
    **of_group: Any,
) -> Evaluation | GroupEvaluation:
    """The figures of `policy`: exact on a `World`, from a replay on the held-out tracks of a `Recorded`.

    Args:
        problem: a `World`, whose episodes end by the target's exit or after `max_steps`; `Recorded` tracks; or a
            `Group` of targets, for which a policy of a single one is merged, and simulated unless the grid is tiny; on
            recorded tracks along all groups of held-out ones.
        policy: a `Policy` or its table, or the same dense, `[M, t_max + 1, M]`; a TensorDict module or a function
            that does not draw (`Policy.from_function`); a `Run`, a `Solution`, a model of Stable-Baselines3; or the
            name of a baseline. A module or model that reads `present` is one for all targets, and taken at its mode.
        false_alarm: p_f, the probability that a sensor that is on reports a target that is not there; the policy
            takes each report for the truth (`trackmdp.solvers.false_alarms`).
        **of_group: of a `Group` alone: `merge`, "gains" or "union" (the default on recorded tracks); `width`, half of
            the 95 % interval of the reward per step that is wanted, .005; and `seed` of the targets.

    Raises:
        UserError: the policy draws at random with unknown probabilities, or is for another grid.
    """
    if isinstance(problem, Group):
        if false_alarm:
            raise UserError(f"false_alarm={false_alarm}: expected 0 with several targets")
        return _of_group(problem, policy, **of_group)
    check_problem(problem, "evaluate")
    table = policy_table(problem, policy, **of_group)
    if false_alarm:
        value.check_revealed(problem.motion, table)
        return believed(problem, table, false_alarm)
    return value.value_of(problem, table)


def _of_group(
    group: Group, policy: Any, *, merge: str | None = None, width: float = 0.005, seed: int = 0
) -> GroupEvaluation:
    """See `evaluate`."""
    with torch_threads(1):
        return evaluate_group(group_rule(group, policy, merge), width=width, seed=seed)


def group_rule(group: Group, policy: Any, merge: str | None = None) -> Rule:
    """A policy for several targets: itself, or the merged plans of single ones, by default as a `Run` has merged them.

    Raises:
        UserError: plans are of other motions, or a policy that was learned for all targets is to be merged.
    """
    merge = merge or getattr(policy, "merge", None)
    held = policy if isinstance(policy, Rule) else getattr(policy, "policy", None)
    spaces = getattr(getattr(policy, "observation_space", None), "spaces", ())
    if "present" in getattr(policy, "in_keys", spaces):
        from trackmdp.solvers.several.joint_rule import JointRule  # which loads torch

        held = JointRule.given(group, policy)
    if not isinstance(held, Rule):
        singles = [group.single] if group.recorded else group.kinds
        return make_rule(group, [policy_table(each, policy) for each in singles], merge)
    rule = held.within(group)
    if merge in (None, rule.name):
        return rule
    if not rule.tables:
        raise UserError(f"merge={merge}: expected none, as the policy is of all targets together")
    return make_rule(group, rule.tables, merge)


def policy_table(problem: Problem, policy: Any, **of_group: Any) -> PolicyTable:
    """The table of a policy in any form; see `of_single`."""
    return value.as_table(problem, of_single(problem, policy, **of_group))


def of_single(problem: Problem, policy: Any, **of_group: Any) -> Any:
    """A policy of a single target, made where it is the name of a baseline.

    Raises:
        UserError: it is one for several targets, or has an option of these.
    """
    if of_group:
        raise UserError(f"{min(of_group)}: an option of several targets, expected none with one")
    if isinstance(policy, Rule):
        raise UserError(
            f"policy: for {len(policy.group)} targets, expected one for a single target"
        )
    return named_policy(problem, policy) if isinstance(policy, str) else policy
