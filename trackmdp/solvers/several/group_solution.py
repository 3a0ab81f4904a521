"""Solving for several targets: the plans of single targets, merged, and a bracket around the best policy of all."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from trackmdp.notebook.card import Card, Carded, decimal, grid_words
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.several.group_bounds import sensors_suffice
from trackmdp.solvers.several.group_tracker import Followed
from trackmdp.solvers.several.merging import Rule, make_rule
from trackmdp.solvers.solution import Solution
from trackmdp.solvers.value import price_at_exit
from trackmdp.world.group import Group


@dataclass(frozen=True, repr=False)
class GroupSolution(Followed, Carded):
    """Plans for several targets.

    Attributes:
        group: the targets.
        singles: the solution of a single target, for each of `group.kinds`.
        upper: proved: no policy has a higher AIHTR.
        seconds: time spent.
    """

    group: Group
    singles: tuple[Solution, ...]
    upper: float
    seconds: float

    @property
    def tables(self) -> tuple[PolicyTable, ...]:
        """The policies of single targets."""
        return tuple(each.table for each in self.singles)

    @cached_property
    def policy(self) -> Rule:
        """The policy that adds up the gains of all targets; with hidden modes the union of their sets."""
        return make_rule(self.group, self.tables)

    @property
    def rule(self) -> Rule:
        """See `Followed`; `policy`."""
        return self.policy

    @property
    def apart(self) -> float:
        """AIHTR of as many separate trackers, each with sensors of its own."""
        return float(sum(self.singles[kind].lower for kind in self.group.kind))

    @cached_property
    def lower(self) -> float | None:
        """Proved: the best policy has no lower AIHTR.

        All own sets together cost no more than apart, but for a target's exit step, paid where others are left; and a
        detection more loses nothing where all sensors can do what the safe action does, and are no dearer. None where
        they are or cannot, a budget forbids the union, a safe action that misses may take the place of sets that would
        not, or modes are hidden.
        """
        task = self.group.task
        if self.group.hidden > 1 or not (sensors_suffice(task) and task.safe):
            return None
        kinds = zip(self.group.kinds, self.tables, strict=True)
        exits = [price_at_exit(*each) if len(self.group) > 1 else 0.0 for each in kinds]
        return self.apart - sum(exits[kind] for kind in self.group.kind)

    def card(self) -> Card:
        """The bracket."""
        per_step = (self.upper - self.apart) / self.group.expected_steps
        facts = {
            "targets": f"{len(self.group)}",
            "separate trackers": decimal(self.apart, 4),
            "upper bound": f"{decimal(self.upper, 4)}; {per_step:.2g} per step above these",
            "proved from below": decimal(self.lower, 4) if self.lower is not None else "no",
            "seconds": f"{self.seconds:.2g}",
        }
        return Card(f"GroupSolution: {grid_words(self.group.task.size)}", facts)
