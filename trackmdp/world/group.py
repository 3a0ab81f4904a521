"""Several targets in one grid that share its sensors (theory.md#several-targets)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import IndexArray, Indices
from trackmdp.config.several import MOST_TARGETS
from trackmdp.errors import UserError
from trackmdp.notebook.card import Card, Carded, grid_words
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.sensing.coverage import Coverage
from trackmdp.sensing.task import Task
from trackmdp.world.model import World
from trackmdp.world.problem import Problem, modelled

_HELD_OUT = "held out (kernel.held_out)"


@dataclass(frozen=True, eq=False, repr=False)
class Group(Carded):
    """K independent, labelled targets: a reward for each detection, and sensors that are paid once.

    The sensors that are on are paid once in a step while any target is in the grid. When any clock runs out, the safe
    action takes their place: it locates all targets, or misses each with probability 1 - p_s, and D is paid once; it is
    repeated while a clock stands at t_max + 1. The tracker is shown which target a report is of, and when one leaves
    the grid; the episode ends with the last one.

    Args:
        worlds: one for each target, alike but for the motion; the same object where targets move alike.
        recorded: tracks that the targets follow in place of these motions, by which their moves are then predicted
            alone; see `of_tracks`. A policy of one of them may have a memory, the worlds have none.

    Raises:
        UserError: they differ in more than the motion, or have hidden modes and a budget, or a memory without modes.
    """

    worlds: Sequence[World]
    recorded: Recorded | None = None

    def __post_init__(self) -> None:
        many = isinstance(self.worlds, Sequence) and 1 <= len(self.worlds) <= MOST_TARGETS
        worlds = tuple(self.worlds) if many else ()
        if not worlds or not all(isinstance(world, World) for world in worlds):
            raise UserError(f"Group: expected a list of 1 to {MOST_TARGETS:,} times a World")
        for number, world in enumerate(worlds):
            of_one = {
                f"budget={world.budget} and hidden modes": world.limited
                and world.modes > world.revealed,
                f"task.memory={world.memory}": world.memory != "cell" and world.modes == 1,
            }
            if name := next(filter(of_one.get, of_one), ""):
                raise UserError(f"targets: {name}, expected none with several targets")
            if not _alike(world, worlds[0]):
                raise UserError(
                    f"Group: target {number} has another grid, price or limit than target 0"
                )
        object.__setattr__(self, "worlds", worlds)  # the dataclass is frozen

    @classmethod
    def of_tracks(cls, recorded: Recorded, count: int) -> Group:
        """Targets on recorded tracks, `count` at the same time; their moves are predicted by the tracks to learn from.

        Tracks whose times overlap are followed together; where the recording has no times, any are (`together`).

        Raises:
            UserError: `recorded` has no tracks, or `count` is no number of targets or above that of the tracks held
                out; or as of `Group`.
        """
        if not hasattr(recorded, "tracks"):
            raise UserError(f"Group.of_tracks: a {type(recorded).__name__}, expected Recorded")
        count = whole_number("Group.of_tracks: count", count, 1, MOST_TARGETS)
        _check_tracks(count, {_HELD_OUT: recorded.held_out})
        kernel = recorded.tracks.kernel(recorded.num_cells)
        return cls([World.of(recorded, kernel, memory="cell")] * count, recorded)

    def __len__(self) -> int:
        return len(self.worlds)

    @property
    def selection(self) -> Group:
        """As of a `Problem`: on recorded tracks those to choose by take the place of the held-out ones."""
        return self if self.recorded is None else Group(self.worlds, self.recorded.selection)

    @cached_property
    def task(self) -> Task:
        """Grid, prices and limits, the same for all targets; what a policy remembers is its own.

        A window limits each target's own plan: together any sensors can be chosen.
        """
        return replace(self.worlds[0].remembering(), window=None)

    @property
    def modes(self) -> int:
        """H, modes of each target."""
        return self.worlds[0].modes

    @property
    def hidden(self) -> int:
        """Modes between which a detection leaves open: H, or 1 where it reveals the mode."""
        return self.modes // self.worlds[0].revealed

    @property
    def states(self) -> int:
        """Z = M · H, states of a target."""
        return self.worlds[0].num_states

    def cell_of(self, state: IndexArray) -> IndexArray:
        """Cells of states of `kernel`, in their shape."""
        return state % self.states // self.modes

    def state_of(self, cells: IndexArray, modes: IndexArray | int = 0) -> IndexArray:
        """`[*E, K]` states of `kernel`, of targets in `cells` and `modes`."""
        return self.kind * self.states + cells * self.modes + modes

    @property
    def targets(self) -> tuple[int, ...]:
        """Kind of each target, as learners get it; see `Task.targets`."""
        return tuple(self.kind.tolist())

    @property
    def model(self) -> None:
        """No world of one target."""

    @cached_property
    def kinds(self) -> tuple[World, ...]:
        """The different motions, by their first target."""
        return tuple({id(world): world for world in self.worlds}.values())

    @property
    def single(self) -> Problem:
        """The first target alone: its world, or the recorded tracks."""
        return self.recorded or self.kinds[0]

    @cached_property
    def kind(self) -> Indices:
        """`[K]`, place of each target's motion in `kinds`."""
        place = {id(world): number for number, world in enumerate(self.kinds)}
        return np.array([place[id(world)] for world in self.worlds])

    @cached_property
    def kernel(self) -> sparse.csr_array:
        """Moves of all kinds, one block `[Z, Z]` after the other: state z of kind k is k · Z + z."""
        return sparse.block_diag([each.kernel for each in self.kinds], "csr")

    @property
    def expected_steps(self) -> float:
        """Expected steps until the last target has left, starts uniform and independent; no policy changes it."""
        return self._steps[0]

    @property
    def target_steps(self) -> float:
        """Expected steps of all targets in the grid, each counted by itself."""
        return self._steps[1]

    @cached_property
    def _steps(self) -> tuple[float, float]:
        inside = [np.full(self.states, 1.0 / self.states) for _ in self.kinds]
        arrivals = [world.kernel.T.tocsr() for world in self.kinds]
        total, each, left, taken = 0.0, 0.0, 1.0, 0
        # What is still to come is about `left` times the total.
        while left > 1e-13 and taken != self.task.max_steps:
            taken += 1
            # The step taken counts where any target was in the grid before it.
            total += left
            inside = [moves @ mass for moves, mass in zip(arrivals, inside, strict=True)]
            there = np.array([mass.sum() for mass in inside])[self.kind]
            each += float(there.sum())
            # 1 - Π (1 - p) in logarithms: with p near 0 the product alone would lose all digits.
            left = float(-np.expm1(np.log1p(-np.minimum(there, 1.0 - 1e-16)).sum()))
        return total, each

    def but(self, **changes: Any) -> Group:
        """The same targets in a task that differs in `changes`."""
        changed = [world.but(**changes) for world in self.kinds]
        recorded = None if self.recorded is None else replace(self.recorded, **changes)
        return Group(tuple(changed[kind] for kind in self.kind), recorded)

    def card(self) -> Card:
        """The card of the first target's world, and how many targets there are."""
        task = self.task
        motions = "all alike" if len(self.kinds) == 1 else f"{len(self.kinds)} motions"
        if self.recorded is not None:
            motions = "on recorded tracks"
        facts = {"targets": f"{len(self)}, {motions}"} | self.single.facts()
        return Card(f"Group: {grid_words(task.size)}", facts)


Subject: TypeAlias = Problem | Group
"""What a learner learns in: one target, or several."""


def check_problem(problem: object, caller: str) -> None:
    """Check the first argument of a public function.

    Raises:
        UserError: it is neither a world nor recorded tracks nor a group of targets.
    """
    if not isinstance(problem, Subject):
        kind = problem.__name__ if isinstance(problem, type) else type(problem).__name__
        raise UserError(
            f"{caller}: the first argument is a {kind}, expected a world (make_world, World) or recorded "
            "tracks (load_tracks)"
        )


def one_target(subject: Subject, caller: str) -> Problem:
    """The subject, if it is of a single target.

    Raises:
        UserError: it is a group.
    """
    if isinstance(subject, Group):
        raise UserError(
            f"{caller}: {len(subject)} targets that were learned together, expected a single one"
        )
    return subject


def group_of(subject: Subject, count: int) -> Group:
    """The targets of a subject, `count` that move alike where it is a world, or on its tracks.

    Raises:
        UserError: it is a group of another number.
    """
    if isinstance(subject, Group):
        if len(subject) != count:
            raise UserError(f"targets.count={count}: expected {len(subject)}, as the policy has")
        return subject
    if subject.recorded is not None:
        return Group.of_tracks(subject.recorded, count)
    return Group([modelled(subject, "Group")] * count)


def learned_in(subject: Subject, count: int, *, joint: bool) -> Subject:
    """Where a learner learns a policy for `count` targets: with all of them, or with a single one.

    Raises:
        UserError: a single one, of targets that do not move alike; or a part of recorded tracks has fewer than `count`.
    """
    if count > 1 and (own := subject.recorded) is not None:
        # Where a single one's plan is learned the figures at the end are of all as well.
        parts = {_HELD_OUT: own.held_out}
        if joint:
            parts["to learn from"] = own.tracks
            parts["to choose by (kernel.validation)"] = own.validation
        _check_tracks(count, parts)
    if joint and count > 1:
        return group_of(subject, count)
    if not isinstance(subject, Group):
        return subject
    if len(subject.kinds) > 1:
        raise UserError(
            f"train: a Group of {len(subject.kinds)} motions, expected one with an algorithm that learns a single "
            "target's plan; train on each world, or take a2c, ppo or dqn"
        )
    return subject.single


def _check_tracks(count: int, parts: Mapping[str, Tracks]) -> None:
    """Check that `count` tracks can be followed at once; fewer may still overlap in time.

    Args:
        count: K.
        parts: of the recording, by their names in messages.

    Raises:
        UserError: a part has fewer tracks.
    """
    for name, part in parts.items():
        if len(part) < count:
            raise UserError(
                f"targets.count={count}: expected at most {len(part)}, the number of tracks {name}"
            )


def _alike(one: World, other: World) -> bool:
    """Whether two worlds are the same task."""
    theirs = other.given
    return one.modes == other.modes and all(
        mine.same_as(theirs[name])
        if isinstance(mine, Coverage)
        else np.array_equal(mine, theirs[name], equal_nan=isinstance(mine, np.ndarray))
        for name, mine in one.given.items()
        if name not in ("place", "clip")
    )
