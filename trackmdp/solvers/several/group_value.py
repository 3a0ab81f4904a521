"""The figures of a policy for several targets: exact by the joint chain on tiny worlds, else simulated.

Clocks of the targets are staggered, so there is no renewal of all of them. Simulated episodes are of the same targets
for every policy of a group (the generators' names have no policy in them), so that differences have little noise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from trackmdp.arrays.entries import per_row, row_index
from trackmdp.arrays.numbers import REAL
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.seeding import derive, whole_seed
from trackmdp.sensing.decisions import report_chance
from trackmdp.solvers.linear import accumulate
from trackmdp.solvers.motion_totals import grid_of, summed_over
from trackmdp.solvers.several.group_chain import joint_chain
from trackmdp.solvers.several.group_figures import GroupEvaluation
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.several.simulation import Moving, group_steps
from trackmdp.world.group import Group

_FIRST = 256
"""Episodes of the first batch, from which the number needed for the wanted width is worked out. From 64 the width may
be met by luck: 92 of 100 intervals cover."""
_AT_ONCE = 2**13
"""Targets of all episodes of a batch, at most."""
_MOST = 2**17
"""Episodes, at most."""
_MOST_ON = 2**27
"""Sensors on in all of them together, at most about so many, which takes minutes: a policy that has thousands on in a
step would otherwise be simulated for hours, to a width that says nothing about it."""


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
        UserError: `width` is no number > 0, or `seed` no whole number.
    """
    seed = whole_seed(seed)  # checked also where the figures are exact and nothing is drawn
    if not isinstance(width, REAL) or not 0 < width < math.inf:
        raise UserError(f"width={width}: expected a number > 0")
    group = rule.group
    if group.recorded is not None:
        # torch is loaded where targets are moved along tracks
        from trackmdp.environment.group_paths import GroupPaths, Walks

        # All groups of held-out tracks, of which each is an episode.
        paths = GroupPaths(group, held_out=True)
        found = _totals(rule, Walks(paths, paths.every()), 0)
        units = "group", " of held-out tracks"
        return GroupEvaluation(found, False, float(found[:, 5].mean()), None, units)
    exact_steps = group.expected_steps, (group.target_steps, known_mean(rule))
    if episodes is None and (exact := joint_chain(rule)) is not None:
        return GroupEvaluation(exact, True, *exact_steps)
    return _played(rule, exact_steps, width, seed, episodes)


def _played(
    rule: Rule, exact_steps: Any, width: float, seed: int, episodes: int | None
) -> GroupEvaluation:
    """See `evaluate_group`; simulated."""
    parts, wanted, count = list[Array](), min(episodes or _FIRST, _MOST), 0
    while True:
        name = f"more {len(parts)}" if parts else "first"
        parts.append(simulated(rule, max(wanted - count, 1), seed, name))
        count = sum(map(len, parts))
        found = GroupEvaluation(np.concatenate(parts), False, *exact_steps)
        now, on = found.reward_per_step, max(float(found.totals[:, 3].sum()), 1.0)
        most = min(_MOST, int(count * (_MOST_ON / on)))
        if episodes is not None or count >= most or now.low is None or now.high is None:
            return found
        half = (now.high - now.low) / 2
        if half <= width:
            return found
        # A little more than the law of the square root asks for, so that few rounds are needed.
        wanted = min(math.ceil(count * min(1.05 * half / width, 3.0) ** 2), 8 * count, most)


def simulated(rule: Rule, episodes: int, seed: int, name: str) -> Array:
    """`[E, 7]` totals of simulated episodes, as in `GroupEvaluation`."""
    each, parts = max(1, _AT_ONCE // len(rule.group)), list[Array]()
    for number, begin in enumerate(range(0, episodes, each)):
        own = derive(seed, "group", name, number)
        rng = np.random.default_rng(derive(own, "motion"))
        parts.append(_totals(rule, _Drawn(rule.group, min(each, episodes - begin), rng), own))
    return np.concatenate(parts)


def known_rewards(rule: Rule) -> list[Array]:
    """For each kind `[M]`, the reward of the first set of a single target in each cell, a mean over its modes."""
    rewards = []
    for world, sets in zip(rule.group.kinds, rule.first_sets(), strict=True):
        cells, row = world.motion.cell, row_index(world.kernel)
        on = sets[cells].astype(np.float64).tocoo()
        codes = np.sort(on.row.astype(np.int64) * world.total_sensors + on.col)
        chance = report_chance(world, codes, row, cells[world.kernel.indices])
        seen = per_row(row, world.kernel.data * chance, world.num_states)
        reward = world.reward * seen - (on @ world.paid) * world.stay_probability
        rewards.append(reward.reshape(world.num_cells, -1).mean(axis=1))
    return rewards


def known_mean(rule: Rule) -> float:
    """The mean over episodes of the sum of `known_rewards` of all targets."""
    means = []
    for world, of_cell in zip(rule.group.kinds, known_rewards(rule), strict=True):
        reward = of_cell[world.motion.cell]
        if world.max_steps is None:
            total = accumulate(world.kernel, reward, grid_of(world))
        else:
            total = summed_over(world.kernel, reward, world.max_steps)
        means.append(float(total.mean()))
    return sum(means[kind] for kind in rule.group.kind)


class _Drawn:
    """Targets of E episodes that move by their motions, all starts and moves drawn from one generator."""

    state: IndexArray
    inside: BoolArray

    def __init__(self, group: Group, episodes: int, rng: np.random.Generator) -> None:
        self._kernel, self._rng = group.kernel, rng
        # Sums of all rows, one after the other: the first of row z is at `sums[indptr[z]]`.
        self._sums = np.concatenate([[0.0], np.cumsum(self._kernel.data)])
        states, shape = group.states, (episodes, len(group))
        own = np.random.default_rng(rng.integers(2**63)).integers(states, size=shape)
        self.state, self.inside = own + group.kind * states, np.ones(shape, bool)

    def move(self, row: IndexArray, step: int) -> None:  # noqa: ARG002
        """See `Moving`; every draw is made in every step."""
        here, inside = self.state[self.inside], self.inside.copy()
        begin, end = self._kernel.indptr[here], self._kernel.indptr[here + 1]
        wanted = self._sums[begin] + self._rng.random(self.state.shape)[self.inside]
        entry = np.searchsorted(self._sums, wanted, side="right") - 1
        inside[self.inside] = entry < end
        self.inside, self.state = inside, self.state.copy()
        self.state[inside] = self._kernel.indices[entry[entry < end]]

    def ended(self) -> BoolArray:
        """See `Moving`."""
        return ~np.any(self.inside, axis=1)


def _totals(rule: Rule, targets: Moving, seed: int) -> Array:
    """`[E, 7]` totals of episodes stepped together, as in `GroupEvaluation`."""
    task, shape = rule.task, targets.state.shape
    rng = np.random.default_rng(derive(seed, "reports"))
    found, known, kind = np.zeros((shape[0], 7)), np.stack(known_rewards(rule)), rule.group.kind
    cell = rule.group.cell_of(targets.state)
    for step in group_steps(rule, targets, lambda *_: rng.random(shape), predicted=False):
        row, present = step.row, step.present[step.row]
        before, detections = step.before.present[row], step.seen[row].sum(axis=1)
        some, (episode, sensor) = present.any(axis=1), np.divmod(step.on, rule.sensors)
        price = np.bincount(episode, task.paid[sensor], shape[0])[row]
        columns = (
            task.reward * detections - np.where(step.late[row], task.safe_cost, price) * some,
            present.sum(axis=1),
            detections,
            np.bincount(episode, minlength=shape[0])[row] * some,
            step.late[row] & some,
            before.any(axis=1),
            (known[kind, cell[row]] * before).sum(axis=1),
        )
        found[row] += np.stack(columns, axis=1)
        cell = step.cell
    return found
