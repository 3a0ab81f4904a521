"""One search problem for every world: its events, steps and decisions, kept for many policies.

`value` follows one policy; a search values many, and improves their plans. The differences between worlds, memories and
sensors are in the events (`walk`) and in the decisions (`choose`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias, cast

import numpy as np

from trackmdp.arrays.entries import ones_at, per_row
from trackmdp.arrays.types import AnyArray, Array, BoolArray, IndexArray
from trackmdp.machine import check_free
from trackmdp.memory.keys import KeySpace
from trackmdp.motion.chain import Motion
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.decisions import Decisions, sensing
from trackmdp.sensing.task import Task
from trackmdp.solvers.events import Events
from trackmdp.solvers.linear import DIRECT_CELLS, TOLERANCE, RenewalSystem
from trackmdp.solvers.mass import Passed, passed, passed_last
from trackmdp.solvers.plans import Plans, Turn, sensed, sets_of
from trackmdp.solvers.value import event_groups, first_events, whole_renewals
from trackmdp.solvers.walk import Step, Walk, all_events
from trackmdp.world.model import World

_DIRECT = 1_500
"""Cells up to which the systems of a search are factorised: above, the value before is so near that iterating is
faster."""
_SEARCHED = 1e-10
"""Tolerance of values in a search over keys of several events, where gains below a ten-millionth do not count."""
_SAMPLED = 256
"""Hidden states on which the memory of a renewal is estimated."""


Act: TypeAlias = tuple[AnyArray, Array]
"""One free choice: `[E]` probability of a report of each entry, `[B]` price of the set after each event."""


class Renewal:
    """All renewals of a task with a motion; sets are bools `[G, 1]`, a list of one for each free choice.

    Args:
        task: sensors, prices and limits.
        motion: of the target.

    Attributes:
        task, motion: as given.
        keys: of the policies.
        free: the steps of the free choices.
        plans: `[K]`, the keys that can occur.
        owner: `[B]`, place in `plans` of the key of each event.

    Raises:
        UserError: there is not enough memory for it.
    """

    def __init__(self, task: Task, motion: Motion) -> None:
        self.task, self.motion = task, motion
        self.keys: KeySpace = task.keys
        self.events = all_events(task, self.keys, motion)
        check_room(task, motion, self.events)
        self._walk = Walk(task, motion, self.events)
        self.free: list[Step] = [self._walk.move() for _ in range(task.num_choices)]
        self.plans, self.owner = np.unique(self.events.key, return_inverse=True)

    @cached_property
    def last(self) -> Step:
        """The step of the safe action, the largest one: made where something asks for it."""
        return self._walk.move()

    @cached_property
    def choices(self) -> list[Decisions]:
        """Decisions of the free choices."""
        located, cell = self.keys.cell(self.plans), self.motion.cell
        return [
            sensing(self.task, self.owner[step.rows], cell[step.states], len(self.plans), located)
            for step in self.free
        ]

    @property
    def size(self) -> tuple[int, int] | None:
        """(rows, columns) where events are the cells of the grid; else None."""
        alone = self.keys.num_classes == self.motion.modes == 1 and self.motion.ends is None
        return self.task.size if alone else None

    @cached_property
    def groups(self) -> tuple[int, int] | IndexArray:
        """`size`, or `[B]` the groups of the events."""
        return event_groups(self.motion, self.states) if self.size is None else self.size

    @property
    def world(self) -> World:
        """The task, which is a world where the motion is its own."""
        return cast(World, self.task)

    @cached_property
    def single(self) -> bool:
        """Whether each key has one event, so that plans of more worth raise the value of every event."""
        return len(self.plans) == self.normal

    @property
    def states(self) -> IndexArray:
        """`[B]`, state of each event."""
        return self.events.state

    @property
    def count(self) -> int:
        """B, events."""
        return len(self.owner)

    @property
    def normal(self) -> int:
        """Events of detections: all but the last ones, of missed safe actions."""
        return self.count - self.events.forced

    @cached_property
    def first(self) -> IndexArray:
        """`[F]`, the event with which each of the F episodes starts."""
        return first_events(self.events, self.motion)

    @cached_property
    def start(self) -> Array:
        """`[B]`, probability that an episode starts with each event."""
        return np.bincount(self.first, minlength=self.count) / len(self.first)

    def passes(self, acts: Iterable[Act]) -> list[Passed]:
        """The steps of all events under a policy; sensors are not counted."""
        task, found = self.task, []
        mass = np.ones(self.normal)
        for step, (report, spent) in zip(self.free, acts, strict=True):
            now, mass = passed(task, step, mass, report, spent, 0.0)
            found.append(now)
        return [*found, passed_last(task, self.motion, self.last, mass)]

    def acts(self, sets: Sequence[AnyArray]) -> Iterator[Act]:
        """Reports and prices of `sets`, or of sensors that are on with such probabilities."""
        for choice, on in zip(self.choices, sets, strict=True):
            paid = per_row(choice.rows, self.task.paid[choice.sensors] * on[:, 0], len(self.plans))
            yield choice.report(on)[:, 0], paid[self.owner]

    def system(
        self, sets: Sequence[AnyArray], *, guessed: bool = False
    ) -> tuple[RenewalSystem, Array]:
        """The linear system of a policy, and `[B]` its expected reward until the next event.

        `guessed`: a value near to the policy's is known, so that iteration is faster on a grid of some size.
        """
        located, gathered = whole_renewals(self.passes(self.acts(sets)))
        direct = _DIRECT if guessed else DIRECT_CELLS
        tolerance = TOLERANCE if self.single else _SEARCHED
        system = RenewalSystem(located, self.groups, direct=direct, tolerance=tolerance)
        return system, gathered[:, 0]

    def problem(
        self, value: Array, weight: Array | None = None, credit: Sequence[Array] | None = None
    ) -> Plans:
        """The plans of all keys, the value of each event given.

        Args:
            value: `[B]` V.
            weight: `[B]`, of each event among those of its key; None: 1.
            credit: for each free choice `[Z]` optimistic gain of locating the target in a state over missing it.
        """
        task, free = self.task, self.free
        detected = [task.reward + value[step.following] for step in free]
        if credit is not None:
            credit = [each[step.states] for each, step in zip(credit, free, strict=True)]
        mass = np.ones(self.normal) if weight is None else weight[: self.normal]
        return Plans(self.turns, mass, detected, self.missed(value), task.reward, credit)

    @cached_property
    def turns(self) -> list[Turn]:
        """Entries and decisions of the plans of all keys."""
        rows = [self.owner[: self.normal], *(self.owner[step.rows] for step in self.free)]
        return [
            Turn(*ends, step.moves, step.stay, choice, self.task.prices[choice.sensors])
            for ends, step, choice in zip(pairwise(rows), self.free, self.choices, strict=True)
        ]

    def missed(self, value: Array) -> Array:
        """`[E]` worth of the target's being missed at the last free choice."""
        task, last = self.task, self.last
        worth = task.reward + value[last.following]
        if last.missed is not None:
            found = task.safe_detection[self.motion.cell[last.states]]
            worth = found * worth + (1.0 - found) * value[last.missed]
        missed: Array = last.moves @ worth - task.safe_cost * last.stay
        return missed[: len(missed) - last.begun]

    def shares(self, visits: Array) -> Array:
        """`[B]`, share of each event in the visits of its key; of a key that is never visited all are alike."""
        owner = self.owner[: self.normal]
        total = self.by_plan(visits)[owner]
        alike = 1.0 / np.bincount(owner)[owner]
        return np.where(total > 1e-12, visits[: self.normal] / np.maximum(total, 1e-300), alike)

    def by_plan(self, visits: Array) -> Array:
        """`[K]`, sums of `visits` `[B]` over the events of each key."""
        return per_row(self.owner[: self.normal], visits[: self.normal], len(self.plans))

    def priced_as(self, task: Task) -> Renewal:
        """The same renewal with the prices of another task."""
        other = copy.copy(self)
        other.task, other.last = task, self.last  # the walk takes its last step once
        other.__dict__.pop("turns", None)
        return other

    def sets(self, policy: PolicyTable) -> list[BoolArray]:
        """The sets of a deterministic policy; sensors where the target cannot be are left out."""
        return sets_of(self.choices, policy, self.plans)

    def table(self, sets: Sequence[BoolArray]) -> PolicyTable:
        """The policy of sets; a key that cannot occur has none."""
        return PolicyTable.from_sensed(self.task, sensed(self.choices, sets, self.plans))


def check_room(task: Task, motion: Motion, events: Events) -> None:
    """Refuse a renewal that free memory cannot hold, before it is asked for.

    Raises:
        UserError: it does not fit.
    """
    keys = events.keys
    if keys.num_classes == motion.modes == 1 or motion.ends is not None:
        return  # cells alone: large grids are searched region by region; on tracks no two paths meet
    needed = _step_bytes(motion, task.num_choices) * len(events.codes)
    check_free(f"task.memory={keys.memory} with {motion.modes} modes", needed)


def _step_bytes(motion: Motion, choices: int) -> float:
    """About the memory of the entries and moves of one event, from a sample of states."""
    states = motion.num_states
    start = np.unique(np.linspace(0, states - 1, _SAMPLED).astype(np.int64))
    moves, reached = motion.moves.astype(bool), ones_at(start, start, motion.moves.shape)[start]
    fan, places = moves.nnz / states, [1.0]
    for _ in range(choices + 1):
        reached = reached @ moves
        places.append(reached.nnz / len(start))
    # Measured: 64 bytes a place, 12 a move, and 48 more while the last moves are sorted.
    return 64 * sum(places[1:]) + fan * (12 * sum(places[:-1]) + 48 * places[-2])
