"""The search for the target from each located cell, the worth of locating it given: the problem that trees prove.

Its keys are the cells, and the state of the target is its cell: branch and bound decides cell by cell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.sensing.decisions import sensing
from trackmdp.solvers.motion_totals import forced_worth
from trackmdp.solvers.plans import Plans, Turn
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.walk import Step
from trackmdp.world.model import World


@dataclass(frozen=True, eq=False)
class InnerProblem:
    """Some sets to be chosen, one after the other, from each located cell.

    Attributes:
        renewal: the events, which are the located cells, and their steps.
        detected: `[M]`, worth of locating the target in each cell, r + V.
        missed: `[M]`, worth of the target in each cell, undetected after the last set.
        length: H, sets to be chosen.
        first: misses before the first of them.
        windowed: whether the task's window limits the sets; not where a known position stands for any located cell.
    """

    renewal: Renewal
    detected: Array
    missed: Array
    length: int
    first: int = 0
    windowed: bool = True

    @classmethod
    def of(cls, renewal: Renewal, value: Array) -> InnerProblem:
        """The problem of one renewal: after the last set comes the safe action. `value`: `[M]`, V."""
        world = renewal.world
        detected = world.reward + value
        return cls(renewal, detected, forced_worth(world, detected), world.num_choices)

    @property
    def world(self) -> World:
        """The problem."""
        return self.renewal.world

    @property
    def steps(self) -> list[Step]:
        """Those of the sets to be chosen."""
        return self.renewal.free[self.first : self.first + self.length]

    @cached_property
    def turns(self) -> list[Turn]:
        """Entries and decisions."""
        turns = self.renewal.turns[self.first : self.first + self.length]
        if self.windowed or self.world.window is None:
            return turns
        return [
            replace(turn, choice=choice, price=self.world.prices[choice.sensors])
            for turn, step in zip(turns, self.steps, strict=True)
            for choice in [sensing(self.world, step.rows, step.states, self.world.num_cells)]
        ]

    def plans(self, mass: Array | None = None, credit: list[Array] | None = None) -> Plans:
        """The plans.

        Args:
            mass: `[E]`, undetected before the first move; None: 1 in each located cell.
            credit: for each set `[M]`, optimistic gain of locating the target in a cell over missing it.
        """
        steps = self.steps
        detected = [self.detected[step.states] for step in steps]
        if credit is not None:
            credit = [each[step.states] for each, step in zip(credit, steps, strict=True)]
        weight = np.ones(self.world.num_cells) if mass is None else mass
        missed = self.missed[steps[-1].states]
        return Plans(self.turns, weight, detected, missed, self.world.reward, credit)
