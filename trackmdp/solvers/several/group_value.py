"""The figures of a policy for several targets: exact by the joint chain on tiny worlds, else simulated.

Clocks of the targets are staggered, so there is no renewal of all of them. Simulated episodes are of the same targets
for every policy of a group (the generators' names have no policy in them), so that differences have little noise.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from trackmdp.arrays.entries import among
from trackmdp.arrays.numbers import REAL
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.seeding import derive
from trackmdp.solvers.linear import accumulate, grid_of, summed_over
from trackmdp.solvers.several.group_chain import joint_chain
from trackmdp.solvers.several.group_figures import GroupEvaluation
from trackmdp.solvers.several.merging import Beliefs, Clocks, Reports, Rule, followed

_FIRST = 64
"""Episodes of the first batch, from which the number needed for the wanted width is worked out."""
_AT_ONCE = 2**13
"""Targets of all episodes of a batch, at most."""
_MOST = 2**17
"""Episodes, at most."""


def evaluate_group(
    rule: Rule, *, width: float = 0.005, seed: int = 0, episodes: int | None = None
) -> GroupEvaluation:
    """Figures of a policy for several targets, exact where the joint chain is small.

    Args:
        rule: the policy.
        width: half of the 95 % interval of the reward per step that is wanted.
        seed: of the targets; the same for every policy.
        episodes: simulate so many, in place of `width`, and never the chain.

    Raises:
        UserError: `width` is no number > 0.
    """
    if not isinstance(width, REAL) or not 0 < width < math.inf:
        raise UserError(f"width={width}: expected a number > 0")
    group = rule.group
    if group.recorded is not None:
        found = _Along(rule).totals()
        return GroupEvaluation(found, False, float(found[:, 5].mean()), None)
    exact_steps = group.expected_steps, (group.target_steps, known_mean(rule))
    if episodes is None and (exact := joint_chain(rule)) is not None:
        return GroupEvaluation(exact, True, *exact_steps)
    return _played(rule, exact_steps, width, seed, episodes)


def _played(
    rule: Rule, exact_steps: Any, width: float, seed: int, episodes: int | None
) -> GroupEvaluation:
    """See `evaluate_group`; simulated."""
    first = simulated(rule, min(episodes or _FIRST, _MOST), seed, "first")
    found = GroupEvaluation(first, False, *exact_steps)
    parts = [first]
    while episodes is None and sum(map(len, parts)) < _MOST:
        now = found.reward_per_step
        assert now.low is not None
        assert now.high is not None
        half, count = (now.high - now.low) / 2, sum(map(len, parts))
        if half <= width:
            break
        # A little more than the law of the square root asks for, so that few rounds are needed.
        wanted = min(math.ceil(count * min(1.05 * half / width, 3.0) ** 2), 8 * count, _MOST)
        parts.append(simulated(rule, max(wanted - count, 1), seed, f"more {len(parts)}"))
        found = GroupEvaluation(np.concatenate(parts), False, *exact_steps)
    return found


def simulated(rule: Rule, episodes: int, seed: int, name: str) -> Array:
    """`[E, 7]` totals of simulated episodes, as in `GroupEvaluation`."""
    each = max(1, _AT_ONCE // len(rule.group))
    begins = range(0, episodes, each)
    batches = [min(each, episodes - begin) for begin in begins]
    return np.concatenate(
        [
            _Batch(rule, count, derive(seed, "group", name, number)).totals()
            for number, count in enumerate(batches)
        ]
    )


def known_rewards(rule: Rule) -> list[Array]:
    """For each kind `[M]`, the reward of the first set of a single target in each cell."""
    rewards = []
    for world, sets in zip(rule.group.kinds, rule.first_sets(), strict=True):
        first = sets.astype(np.float64)
        seen = world.kernel.multiply(first) @ world.detection
        rewards.append(world.reward * seen - (first @ world.paid) * world.stay_probability)
    return rewards


def known_mean(rule: Rule) -> float:
    """The mean over episodes of the sum of `known_rewards` of all targets."""
    means = []
    for world, reward in zip(rule.group.kinds, known_rewards(rule), strict=True):
        if world.max_steps is None:
            total = accumulate(world.kernel, reward, grid_of(world))
        else:
            total = summed_over(world.kernel, reward, world.max_steps)
        means.append(float(total.mean()))
    return sum(means[kind] for kind in rule.group.kind)


class _Batch:
    """E episodes stepped together.

    Args:
        rule: the policy.
        episodes: E.
        seed: of all draws.
    """

    def __init__(self, rule: Rule, episodes: int, seed: int) -> None:
        self.rule, self.group, self.task = rule, rule.group, rule.task
        self.shape = (episodes, len(rule.group))
        self.moves = np.random.default_rng(derive(seed, "motion"))
        self.reports = np.random.default_rng(derive(seed, "reports"))
        kernel = self.group.kernel
        self.states, self.cells = kernel.shape[0], self.task.num_cells
        # Sums of all rows, one after the other: the first of row z is at `sums[indptr[z]]`.
        self.sums = np.concatenate([[0.0], np.cumsum(kernel.data)])
        self.known = np.concatenate(known_rewards(rule))
        self.clocks = self._start()
        self.place = self.clocks.located

    def _start(self) -> Clocks:
        cell = np.random.default_rng(self.moves.integers(2**63)).integers(
            self.cells, size=self.shape
        )
        return self.rule.start(cell + self.group.kind * self.cells)

    def totals(self) -> Array:
        """`[E, 7]`."""
        beliefs, found = Beliefs.of(self.clocks), np.zeros((self.shape[0], 7))
        moved = Beliefs.at(*np.zeros((2, 0), dtype=np.int64))
        for _ in itertools.count() if self.task.max_steps is None else range(self.task.max_steps):
            if not self.clocks.present.any():
                break
            if not self.rule.reads_history:
                moved = beliefs.moved(self.group)
            found[:, 6] += (self.known[self.place] * self.clocks.present).sum(axis=1)
            on = self.rule.sets(self.clocks, moved)
            beliefs = self._step(moved, on, found)
        return found

    def _step(self, moved: Beliefs, on: IndexArray, found: Array) -> Beliefs:
        """One step with the sensors `on`; adds to the totals, and returns the beliefs after it."""
        task, clocks, shape = self.task, self.clocks, self.shape
        before = clocks.present
        forced = clocks.late(task.t_max)
        on = on[~forced[on // self.cells]]
        self.place, present = self._moved(before)
        episode = np.broadcast_to(np.arange(shape[0])[:, None], shape)
        cell = self.place % self.cells
        report = among(on, episode * self.cells + cell)[1] | forced[:, None]
        if not (task.perfect and task.safe):
            chance = np.where(forced[:, None], task.safe_detection[cell], task.detection[cell])
            report &= self.reports.random(shape) < chance
        seen = present & report
        self._add(found, on, seen, present, before, forced)
        reports = self._followed(present, seen)
        self.clocks, beliefs = followed(self.group, clocks, moved, on, self.place, reports)
        return beliefs

    def _moved(self, before: BoolArray) -> tuple[IndexArray, BoolArray]:
        """Places after a move, and which targets are in the grid; every draw is made in every step."""
        kernel = self.group.kernel
        begin, end = kernel.indptr[self.place], kernel.indptr[self.place + 1]
        wanted = self.sums[begin] + self.moves.random(self.shape)
        entry = np.searchsorted(self.sums, wanted, side="right") - 1
        present = before & (entry < end)
        place = self.place.copy()
        place[present] = kernel.indices[entry[present]]
        return place, present

    def _followed(self, present: BoolArray, seen: BoolArray) -> Reports:
        """Which targets are followed on after a step, and which of them were located."""
        return present, seen

    def _add(
        self,
        found: Array,
        on: IndexArray,
        seen: BoolArray,
        present: BoolArray,
        before: BoolArray,
        forced: BoolArray,
    ) -> None:
        task, count = self.task, self.shape[0]
        any_left, episode = present.any(axis=1), on // self.cells
        price = np.bincount(episode, task.paid[on % self.cells], count)
        spent = np.where(forced, task.safe_cost, price) * any_left
        detections = seen.sum(axis=1)
        found[:, 0] += task.reward * detections - spent
        found[:, 1] += present.sum(axis=1)
        found[:, 2] += detections
        found[:, 3] += np.bincount(episode, minlength=count) * any_left
        found[:, 4] += forced & any_left
        found[:, 5] += before.any(axis=1)


class _Along(_Batch):
    """All groups of held-out tracks, of which each is an episode."""

    def __init__(self, rule: Rule) -> None:
        # torch is loaded where targets are moved along tracks
        from trackmdp.environment.group_paths import AlongTracks

        assert rule.group.recorded is not None
        self.paths = AlongTracks(rule.group.recorded, len(rule.group), held_out=True)
        self.at = self.paths.every()
        super().__init__(rule, len(self.at), 0)

    def _start(self) -> Clocks:
        return self.rule.start(*self._cells())

    def _cells(self) -> tuple[IndexArray, BoolArray]:
        """`[E, K]`, cells of the targets, and whether they are in the grid."""
        return self.paths.cell(self.at).numpy(), self.paths.inside(self.at).numpy()

    def _moved(self, before: BoolArray) -> tuple[IndexArray, BoolArray]:
        self.at = self.paths.move(self.at, 0 * self.at)  # which is certain
        cell, inside = self._cells()
        self.entered = inside & ~before
        return cell, inside & before

    def _followed(self, present: BoolArray, seen: BoolArray) -> Reports:
        # Where all recordings stop that are left, the episode is over.
        inside = (present | self.entered) & ~self.paths.ended(self.at).numpy()[:, None]
        return inside, (seen | self.entered) & inside
