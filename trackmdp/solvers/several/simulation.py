"""Episodes of several targets stepped together: the same order of events and the same arithmetic as in `TrackEnv`."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np

from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.sensing.decisions import report_chance
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.several.merging import Rule, followed


class Moving(Protocol):
    """The targets of E episodes.

    Attributes:
        state: `[E, K]`, states of `Group.kernel`; of no meaning where targets are not in the grid.
        inside: `[E, K]`, whether they are in the grid.
    """

    state: IndexArray
    inside: BoolArray

    def move(self, row: IndexArray, step: int) -> None:
        """Move all targets; `row` are the episodes still running."""

    def ended(self) -> BoolArray:
        """`[E]`, whether an episode ends here."""


Uniform: TypeAlias = Callable[[IndexArray, int], Array]
"""`[E, K]` uniform in [0, 1), of the reports in a step, for the running episodes `row`."""


@dataclass(frozen=True)
class GroupStep:
    """A step of E episodes, those that have ended included.

    Attributes:
        row: the episodes still running.
        before: clocks before it.
        moved: beliefs after the move.
        on: sorted numbers e · S + j of the sensors j that are on in episode e.
        late: `[E]`, whether the safe action takes their place.
        cell: `[E, K]`, cells after the move, 0 where targets are not in the grid.
        inside: `[E, K]`, whether they are in the grid.
        seen: `[E, K]`, which of the targets that were there before are, and were reported.
    """

    row: IndexArray
    before: Clocks
    moved: Beliefs
    on: IndexArray
    late: BoolArray
    cell: IndexArray
    inside: BoolArray
    seen: BoolArray

    @property
    def present(self) -> BoolArray:
        """`[E, K]`, which of the targets that were in the grid before still are."""
        return self.before.present & self.inside

    @property
    def entered(self) -> BoolArray:
        """`[E, K]`, which targets have entered; each is located, and has no part in the step's reward."""
        return self.inside & ~self.before.present


def group_steps(
    rule: Rule, targets: Moving, draws: Uniform, *, predicted: bool
) -> Iterator[GroupStep]:
    """The steps of all episodes, until the last target of the last one has left, or to the last step allowed.

    Args:
        rule: the policy, and its targets.
        targets: at their starts; moved by each step.
        draws: of the reports; asked for where sensors or the safe action may miss.
        predicted: whether beliefs are wanted where the policy does not read them.
    """
    task, group, sensors = rule.task, rule.group, rule.sensors
    clocks = rule.start(targets.state, targets.inside)
    beliefs = Beliefs.of(group, clocks.present, targets.state)
    sure = task.perfect and task.safe
    for number in itertools.count() if task.max_steps is None else range(task.max_steps):
        if not len(row := np.flatnonzero(clocks.present.any(axis=1))):
            return
        moved = beliefs.moved(group) if predicted or rule.reads_beliefs else Beliefs.none()
        late = clocks.late(task.t_max)
        on = rule.sets(clocks, moved)
        on = on[~late[on // sensors]]
        targets.move(row, number)
        inside = targets.inside
        cell = np.where(inside, group.cell_of(targets.state), 0)
        here, chance = np.flatnonzero(inside), np.zeros(cell.shape)
        chance.ravel()[here] = report_chance(task, on, here // len(group), cell.ravel()[here])
        chance = np.where(late[:, None], task.safe_detection[cell], chance)
        report = chance > 0 if sure else draws(row, number) < chance
        seen = clocks.present & inside & report
        step = GroupStep(row, clocks, moved, on, late, cell, inside, seen)
        going = inside & ~targets.ended()[:, None]
        reports = going, (seen | step.entered) & going
        clocks, beliefs = followed(rule, clocks, moved, on, targets.state, reports)
        yield step
