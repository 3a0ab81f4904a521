"""Simulated episodes of several targets, each from its own generators; see `Episodes` and `simulate`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy import sparse

from trackmdp.arrays.types import Array, IndexArray
from trackmdp.environment.group_paths import GroupPaths, Walks
from trackmdp.episodes.batch import Episodes
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.episode_draws import Columns, Draws, joined, narrow, uniform
from trackmdp.notebook.card import Card, grid_words
from trackmdp.sensing.outcomes import Costs
from trackmdp.solvers.several.group_figures import GroupEvaluation, with_ends
from trackmdp.solvers.several.group_value import known_mean, known_rewards
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.several.simulation import GroupStep, group_steps
from trackmdp.world.group import Group

_AT_ONCE = 4096
"""Targets of the episodes that are stepped together; 256 steps of their draws are held, 8 MB."""
_BELIEFS = 2**22
"""Numbers of the beliefs that are kept together, at most, if a target may be in 30 cells in each step."""


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
                facts[name.replace("_", " ").replace("aihtr", "AIHTR")] = with_ends(
                    getattr(found, name)
                )
        return Card(f"GroupEpisodes: {len(self):,} (figures: 95 % intervals)", facts)

    def figures(self) -> GroupEvaluation:  # type: ignore[override]
        """The policy's figures from the episodes, with 95 % intervals."""
        group = self.problem
        totals = np.array([self._totals(each) for each in self]).reshape(-1, 7)
        if group.recorded is not None:
            units = "simulated episode", " along held-out tracks"
            return GroupEvaluation(totals, False, float(totals[:, 5].mean()), None, units)
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
    def _at_once(self) -> tuple[int, int]:
        targets = len(self.problem)
        return max(1, _AT_ONCE // targets), _BELIEFS // (30 * targets)

    def _completed(self, begin: int, end: int) -> Iterator[Episode]:
        """Simulated once more."""
        some = batches(self.policy, self.seeds[begin:end])
        found = (belief for each in some for belief in each.beliefs())
        for episode, belief in zip(self[begin:end], found, strict=True):
            yield replace(episode, belief=belief)


def batches(rule: Rule, seeds: Sequence[int]) -> Iterator[_Batch]:
    """One episode for each of `seeds`, each independent of the others."""
    each, paths = max(1, _AT_ONCE // len(rule.group)), GroupPaths(rule.group, held_out=True)
    for begin in range(0, len(seeds), each):
        yield _Batch(rule, paths, seeds[begin : begin + each])


class _Batch:
    """E episodes stepped together until the last one has ended."""

    def __init__(self, rule: Rule, paths: GroupPaths, seeds: Sequence[int]) -> None:
        self._rule, self._task, self._costs = rule, rule.task, Costs(rule.task)
        self._shape, self._modal = (len(seeds), len(rule.group)), rule.group.modes > 1
        # As with one target, moves and reports apart, so that two policies with one seed meet the same targets.
        draw, targets = paths.sampler.draw, self._shape[1]
        moves = Draws(seeds, lambda count, rng: draw(count * targets, rng).view(count, targets))
        place = torch.stack([paths.begin(rng) for rng in moves.generators])
        self._walks = Walks(paths, place, moves.at)
        self._seen = uniform(seeds, "report", targets)

    @torch.no_grad()
    def _steps(self, *, predicted: bool) -> Iterator[GroupStep]:
        return group_steps(self._rule, self._walks, self._reports, predicted=predicted)

    def _reports(self, row: IndexArray, step: int) -> Array:
        """`[E, K]` draws of the reports."""
        draws = np.ones(self._shape)
        draws[row] = self._seen.at(torch.from_numpy(row), step).numpy()
        return draws

    def run(self) -> Columns:
        """Columns of `GroupEpisodes`, stepped until the last target has left, or until the last step allowed."""
        walks, cell = self._walks, self._rule.group.cell_of(self._walks.state)
        start = np.where(walks.inside, cell, self._task.num_cells).astype(np.int64)
        begun = {"start": start} | ({"start_mode": self._modes()} if self._modal else {})
        columns, length = joined([self._taken(step) for step in self._steps(predicted=False)])
        return columns | begun | {"length": length}

    def _modes(self) -> IndexArray:
        """`[E, K]`, the modes of all targets, -1 of those that are not in the grid."""
        return np.where(self._walks.inside, self._walks.state % self._rule.group.modes, -1)

    def _taken(self, step: GroupStep) -> Columns:
        """The columns of a step."""
        task, row = self._task, step.row
        some, seen = np.any(step.present[row], axis=1), step.seen[row]
        action = np.zeros((self._shape[0], task.total_sensors), bool)
        action.ravel()[step.on] = True
        action = action[row]
        spent = self._costs.price_of(torch.from_numpy(action))
        spent = torch.where(torch.from_numpy(step.late[row]), task.safe_cost, spent)
        earned = task.reward * torch.from_numpy(seen).sum(-1)
        columns: Columns = {
            "misses": step.before.misses[row],
            "sensors": action.sum(axis=1),
            "bits": np.packbits(action, axis=1),
            "reward": (earned - spent * torch.from_numpy(some)).float().numpy(),
            "target": np.where(step.inside, step.cell, task.num_cells)[row],
            "located": seen | step.entered[row],
            # In an episode's last step, whether a target was in the grid, which no exit ended then.
            "truncated": some,
            "row": row,
        }
        if self._modal:
            columns["mode"] = self._modes()[row]
        return {name: narrow(column) for name, column in columns.items()}

    def beliefs(self) -> Iterator[sparse.csr_array]:
        """`[T · K, M]`, predicted in each step of each episode; see `Episode`."""
        (episodes, targets), cells = self._shape, self._task.num_cells
        taken, rows = list[Columns](), list[IndexArray]()
        for t, step in enumerate(self._steps(predicted=True)):
            moved = step.moved
            episode, target = np.divmod(moved.row, targets)
            place, mass = target + t * targets, moved.mass.astype(np.float32)
            cell = self._rule.group.cell_of(moved.state)
            taken.append({"row": episode, "place": place, "cell": cell, "mass": mass})
            rows.append(step.row)
        columns, counts = joined(taken, episodes)
        lengths = np.bincount(np.concatenate(rows), minlength=episodes).tolist()
        ends = np.cumsum(counts)[:-1]
        parts = (np.split(columns[name], ends) for name in ("place", "cell", "mass"))
        for place, cell, mass, length in zip(*parts, lengths, strict=True):
            belief = sparse.csr_array((mass, (place, cell)), shape=(length * targets, cells))
            belief.eliminate_zeros()
            yield belief
