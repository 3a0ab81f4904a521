"""Simulated episodes of several targets; see `Episodes`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.episodes.batch import Episodes
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.group_simulate import AT_ONCE, group_beliefs
from trackmdp.notebook.card import Card, grid_words
from trackmdp.solvers.several.group_figures import GroupEvaluation, with_ends
from trackmdp.solvers.several.group_value import known_mean, known_rewards
from trackmdp.solvers.several.merging import Rule
from trackmdp.world.group import Group

_BELIEFS = 2**22
"""Numbers of the beliefs that are kept together, at most, if a target may be in 30 cells in each of 100 steps."""


@dataclass(frozen=True, eq=False, repr=False)
class GroupEpisodes(Episodes):
    """The episodes of one policy for several targets: cells, misses and detections are `[S, K]`, starts `[E, K]`."""

    problem: Group
    policy: Rule

    def card(self) -> Card:
        """Number of episodes and targets, and their figures with intervals."""
        task, steps = self.problem.task, len(self.target)
        facts = {"targets": f"{len(self.problem)}", "steps": f"{steps:,}"}
        facts["problem"] = f"Group, {grid_words(task.size)}, T_max {task.t_max}"
        if len(self) > 1:
            found = self.figures()
            for name in ("aihtr", "accuracy", "sensors_per_step", "safe_per_step"):
                facts[name.replace("_", " ")] = with_ends(getattr(found, name))
        return Card(f"Episodes: {len(self):,} (figures: 95 % intervals)", facts)

    def figures(self) -> GroupEvaluation:  # type: ignore[override]
        """The policy's figures from the episodes, with 95 % intervals."""
        group = self.problem
        totals = np.array([self._totals(each) for each in self]).reshape(-1, 7)
        if group.recorded is not None:
            return GroupEvaluation(totals, False, float(totals[:, 5].mean()), None)
        controls = group.target_steps, known_mean(self.policy)
        return GroupEvaluation(totals, False, group.expected_steps, controls)

    @cached_property
    def _known(self) -> Array:
        return np.stack(known_rewards(self.policy))

    def _totals(self, episode: Episode) -> list[float]:
        """A row of `GroupEvaluation`."""
        cells, kind = self.problem.task.num_cells, self.problem.kind
        before = np.concatenate([episode.start[None], episode.target[:-1]])
        # The step in which a target enters is none of its own.
        inside = (episode.target < cells) & (before < cells)
        known = np.where(before < cells, self._known[kind, np.minimum(before, cells - 1)], 0.0)
        forced, some = episode.forced(self.problem.task.t_max), inside.any(axis=1)
        on = episode.action.sum(axis=1) * some
        counts = (inside, episode.located & inside, on, forced & some)
        return [
            float(episode.returns[-1]),
            *(float(each.sum()) for each in counts),
            float(len(episode)),
            float(known.sum()),
        ]

    @property
    def _at_once(self) -> int:
        return max(1, min(AT_ONCE, _BELIEFS // 3000) // len(self.problem))

    def _completed(self, begin: int, end: int) -> Iterator[Episode]:
        """Simulated once more."""
        found = group_beliefs(self.policy, self.seeds[begin:end])
        for episode, belief in zip(self[begin:end], found, strict=True):
            yield replace(episode, belief=belief)
