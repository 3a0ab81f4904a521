"""The result of solving a world: a policy, its figures, and a proved bound on every policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.notebook.card import Card, Carded, decimal, grid_words
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.value import value_of
from trackmdp.world.model import World

if TYPE_CHECKING:  # torch is loaded where a policy is to act
    from trackmdp.policies.policy import Policy


@dataclass(frozen=True, repr=False)
class Solution(Carded):
    """The best policy found and the bounds proved for it.

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

    def card(self) -> Card:
        """The bracket and the figures of the policy."""
        task = self.table.task
        gap = self.upper - self.lower
        facts = {
            f"{self.title} AIHTR": decimal(self.lower, 4),
            "upper bound": f"{decimal(self.upper, 4)}; {self.ended}, gap {gap:.2g}",
            "search": f"{self.nodes:,} nodes, {self.seconds:.2g} s",
        }
        title = f"Solution: {grid_words(task.size)}, T_max {task.t_max}"
        figures = self.evaluation.facts()
        del figures["AIHTR"]  # the lower end of the bracket
        return Card(title, facts | figures)

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
    def title(self) -> str:
        """Name of the policy in tables: the optimum only where it is proved."""
        return "optimal" if self.certified else "best known"

    @property
    def ended(self) -> str:
        """How the search ended, in words."""
        if self.certified:
            return "certified"
        if self.timed_out:
            return "not closed, stopped by the time limit (another machine may end elsewhere)"
        return "interrupted" if self.interrupted else "not closed"

    def uninterrupted(self) -> Solution:
        """Itself, for what is of no use in part.

        Raises:
            KeyboardInterrupt: Ctrl-C ended the search.
        """
        if self.interrupted:
            raise KeyboardInterrupt
        return self

    @property
    def upper(self) -> float:
        """No policy has a higher AIHTR."""
        # Means of the same numbers in another order differ in the last bit.
        return max(float(self.bound.mean()), self.lower)


@dataclass(frozen=True)
class SearchProgress:
    """How far a search has come: the bracket around the optimal AIHTR, and seconds and nodes so far.

    `stage` names the work in progress; `left` is the estimate of its remaining seconds, where a grid is gone through
    region by region.
    """

    lower: float
    upper: float
    seconds: float
    nodes: int
    stage: str = ""
    left: float | None = None

    def __str__(self) -> str:
        bracket = f"bracket {self.lower:,.4f} ... {self.upper:,.4f}"
        line = f"{self.seconds:.0f} s  {bracket}  {self.nodes:,} nodes"
        return line if self.left is None else f"{line}  {self.stage}, {self.left:.0f} s left"


OnProgress: TypeAlias = Callable[[SearchProgress], None] | None
"""Called with the progress of a search; None: nobody looks."""


def unit(world: World, value: float) -> float:
    """What a bracket around `value` is measured by: the value itself, or the reward of a detection where that is more.

    Both change with the unit of rewards and prices, so that what counts as closed does not.
    """
    return max(world.reward, abs(value))


def bracketed(
    world: World,
    table: PolicyTable,
    seconds: float,
    bound: Array | None = None,
    tolerance: float = 1e-6,
) -> Solution:
    """A policy found in another way, in `seconds`, under a proved `bound` `[M]`, by default the clocked one."""
    evaluation = value_of(world, table)
    bound = np.maximum(clocked(world) if bound is None else bound, evaluation.value)
    gap = float((bound - evaluation.value).mean()) + evaluation.error
    certified = gap <= tolerance * unit(world, evaluation.aihtr)
    return Solution(table, evaluation, bound, certified, seconds, nodes=0, interrupted=False)
