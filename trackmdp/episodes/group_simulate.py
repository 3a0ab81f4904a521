"""Simulating episodes of several targets, each from its own generators; see `simulate`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from scipy import sparse

from trackmdp.arrays.types import Array, IndexArray
from trackmdp.environment.group_paths import GroupPaths, Walks
from trackmdp.episodes.episode_draws import Columns, Draws, joined, narrow, uniform
from trackmdp.sensing.outcomes import Costs
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.several.simulation import GroupStep, group_steps

AT_ONCE = 4096
"""Targets of the episodes that are stepped together; 256 steps of their draws are held, 8 MB."""


def group_columns(rule: Rule, seeds: Sequence[int]) -> list[Columns]:
    """Columns of `GroupEpisodes` in batches: one episode for each of `seeds`, each independent of the others."""
    return [each.run() for each in _batches(rule, seeds)]


def group_beliefs(rule: Rule, seeds: Sequence[int]) -> list[sparse.csr_array]:
    """`[T · K, M]`, predicted in each step of these episodes; see `Episode`."""
    return [belief for each in _batches(rule, seeds) for belief in each.beliefs()]


def _batches(rule: Rule, seeds: Sequence[int]) -> Iterator[_Batch]:
    each, paths = max(1, AT_ONCE // len(rule.group)), GroupPaths(rule.group, held_out=True)
    for begin in range(0, len(seeds), each):
        yield _Batch(rule, paths, seeds[begin : begin + each])


class _Batch:
    """E episodes stepped together until the last one has ended."""

    def __init__(self, rule: Rule, paths: GroupPaths, seeds: Sequence[int]) -> None:
        self._rule, self._task, self._costs = rule, rule.task, Costs(rule.task)
        self._shape = len(seeds), len(rule.group)
        # As with one target, moves and reports apart, so that two policies with one seed meet the same targets.
        draw, targets = paths.sampler.draw, self._shape[1]
        moves = Draws(seeds, lambda count, rng: draw(count * targets, rng).view(count, targets))
        place = torch.stack([paths.begin(rng) for rng in moves.generators])
        self._walks = Walks(paths, place, moves.at)
        self._seen = uniform(seeds, "report", targets)

    @torch.no_grad()
    def _steps(self) -> Iterator[GroupStep]:
        return group_steps(self._rule, self._walks, self._reports)

    def _reports(self, row: IndexArray, step: int) -> Array:
        """`[E, K]` draws of the reports."""
        draws = np.ones(self._shape)
        draws[row] = self._seen.at(torch.from_numpy(row), step).numpy()
        return draws

    def run(self) -> Columns:
        """Step until the last target of the last episode has left, or until the last step allowed."""
        walks, cells = self._walks, self._task.num_cells
        start = np.where(walks.inside, walks.state % cells, cells).astype(np.int64)
        columns, length = joined([self._taken(step) for step in self._steps()])
        return columns | {"start": start, "length": length}

    def _taken(self, step: GroupStep) -> Columns:
        """The columns of a step."""
        task, some = self._task, np.any(step.present, axis=1)
        action = np.zeros((self._shape[0], task.num_cells), dtype=bool)
        action.ravel()[step.on] = True
        spent = self._costs.price_of(torch.from_numpy(action))
        spent = torch.where(torch.from_numpy(step.late), task.safe_cost, spent)
        earned = task.reward * torch.from_numpy(step.seen).sum(-1)
        columns: Columns = {
            "misses": step.before.misses,
            "sensors": action.sum(axis=1),
            "bits": np.packbits(action, axis=1),
            "reward": (earned - spent * torch.from_numpy(some)).float().numpy(),
            "target": np.where(step.inside, step.cell, task.num_cells),
            "located": step.seen | step.entered,
            # In an episode's last step, whether a target was in the grid, which no exit ended then.
            "truncated": some,
            "row": np.arange(len(action)),
        }
        return {name: narrow(column[step.row]) for name, column in columns.items()}

    def beliefs(self) -> Iterator[sparse.csr_array]:
        """`[T · K, M]` of each episode."""
        steps = [(step.row, step.moved) for step in self._steps()]
        episodes, targets = self._shape
        lengths = np.bincount(np.concatenate([row for row, _ in steps]), minlength=episodes)
        for number, length in enumerate(lengths.tolist()):
            first, rows, columns, masses = number * targets, list[Any](), list[Any](), list[Any]()
            for t, (_, moved) in enumerate(steps[:length]):
                mine = slice(*np.searchsorted(moved.row, [first, first + targets]))
                rows.append(moved.row[mine] - first + t * targets)
                columns.append(moved.state[mine] % self._task.num_cells)
                masses.append(moved.mass[mine].astype(np.float32))
            entries = np.concatenate(masses), (np.concatenate(rows), np.concatenate(columns))
            belief = sparse.csr_array(entries, shape=(length * targets, self._task.num_cells))
            belief.eliminate_zeros()
            yield belief
