"""What solving a world gives: a policy, what it earns, and what is proved about the best there is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.world.model import Array, World

if TYPE_CHECKING:  # torch is loaded where a policy is to act
    from trackmdp.policies.policy import Policy


@dataclass(frozen=True)
class Solution:
    """The best policy found and what is proved about it.

    Attributes:
        table: the sets of the policy; `policy` acts them out.
        evaluation: its exact figures.
        bound: `[M]`, proved: V*(x) <= bound[x].
        certified: whether the means of `value` and `bound` agree within the tolerance.
        seconds: time spent.
        nodes: branch-and-bound choices looked at.
        interrupted: whether the user stopped the search (Ctrl-C).
        timed_out: whether a time limit did, so that the bracket depends on the machine.
    """

    table: PolicyTable
    evaluation: Evaluation
    bound: Array
    certified: bool
    seconds: float
    nodes: int
    interrupted: bool
    timed_out: bool = False

    @cached_property
    def policy(self) -> Policy:
        """The policy as a TensorDict module."""
        from trackmdp.policies.policy import as_policy

        return as_policy(self.table.task, self.table)

    @property
    def value(self) -> Array:
        """`[M]`, the policy's value; V*(x) >= value[x] - evaluation.error."""
        return self.evaluation.value

    @property
    def lower(self) -> float:
        """The policy's AIHTR."""
        return self.evaluation.aihtr

    @property
    def ended(self) -> str:
        """How the search ended, in words."""
        if self.certified:
            return "certified"
        if self.timed_out:
            return "not closed, stopped by the time limit (another machine may end elsewhere)"
        return "interrupted" if self.interrupted else "not closed"

    @property
    def upper(self) -> float:
        """No policy has a higher AIHTR."""
        return float(self.bound.mean())


@dataclass(frozen=True)
class SearchProgress:
    """How far a search has come: the bracket around the optimal AIHTR, and seconds and nodes so far.

    `stage` says what is being done and `left` how many seconds more that will take, where a grid is gone through region
    by region.
    """

    lower: float
    upper: float
    seconds: float
    nodes: int
    stage: str = ""
    left: float | None = None


def bracketed(world: World, table: PolicyTable, seconds: float, tolerance: float = 1e-6) -> Solution:
    """A policy found in another way, in `seconds`, with the clocked bound as what is proved."""
    evaluation = evaluate(world, table, per_cell=False)
    bound = np.maximum(clocked(world), evaluation.value)
    gap = float((bound - evaluation.value).mean()) + evaluation.error
    certified = gap <= tolerance * max(1.0, abs(evaluation.aihtr))
    return Solution(table, evaluation, bound, certified, seconds, nodes=0, interrupted=False)
