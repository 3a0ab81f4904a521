"""Simulating episodes of several targets, each from its own generators; see `simulate`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.arrays.types import IndexArray
from trackmdp.environment.group_paths import GroupPaths, group_paths
from trackmdp.episodes.episode_draws import Columns, Draws, joined, uniform
from trackmdp.episodes.group_episode import GroupEpisode
from trackmdp.sensing.outcomes import Costs
from trackmdp.solvers.several.merging import Beliefs, Clocks, Rule, followed

AT_ONCE = 4096
"""Targets of the episodes that are stepped together; 256 steps of their draws are held, 8 MB."""


@torch.no_grad()
def group_episodes(
    rule: Rule, seeds: Sequence[int], *, beliefs: bool = False
) -> list[GroupEpisode]:
    """One episode for each of `seeds`, in their order; each independent of the others.

    Args:
        rule: the policy, and its targets.
        seeds: of the episodes.
        beliefs: whether beliefs are kept.
    """
    each, paths = max(1, AT_ONCE // len(rule.group)), group_paths(rule.group, held_out=True)
    return [
        episode
        for begin in range(0, len(seeds), each)
        for episode in _Batch(rule, paths, seeds[begin : begin + each], beliefs).run()
    ]


class _Batch:
    """E episodes stepped together until the last one has ended."""

    def __init__(self, rule: Rule, paths: GroupPaths, seeds: Sequence[int], beliefs: bool) -> None:
        self._rule, self._group, self._paths = rule, rule.group, paths
        self._task, self._costs, self._seeds = rule.task, Costs(rule.task), seeds
        self._shape = len(seeds), len(rule.group)
        # As with one target, moves and reports apart, so that two policies with one seed meet the same targets.
        draw, targets = paths.sampler.draw, self._shape[1]
        moves = Draws(seeds, lambda count, rng: draw(count * targets, rng).view(count, targets))
        self._moves, self._seen = moves, None
        if not (rule.task.perfect and rule.task.safe):
            self._seen = uniform(seeds, "report", targets)
        self._taken: list[Columns] = []
        self._kept: list[Beliefs] | None = [] if beliefs else None

    def run(self) -> list[GroupEpisode]:
        """Step until the last target of the last episode has left, or until the last step allowed."""
        paths, most = self._paths, self._task.max_steps
        place = torch.stack([paths.begin(rng) for rng in self._moves.generators])
        state, inside = paths.state(place).numpy(), paths.inside(place).numpy()
        clocks = self._rule.start(state, inside)
        starts = np.where(inside, state % self._task.num_cells, self._task.num_cells)
        beliefs, step = Beliefs.of(clocks), 0
        while step != most and len(row := np.flatnonzero(clocks.present.any(axis=1))):
            place, clocks, beliefs = self._step(row, step, place, clocks, beliefs)
            step += 1
        steps, lengths = joined(self._taken)
        ends = np.cumsum(lengths)[:-1]
        columns = {name: np.split(column, ends) for name, column in steps.items()}
        return [
            self._episode(number, start, {name: column[number] for name, column in columns.items()})
            for number, start in enumerate(starts)
        ]

    def _step(
        self, row: IndexArray, step: int, place: Tensor, clocks: Clocks, beliefs: Beliefs
    ) -> tuple[Tensor, Clocks, Beliefs]:
        """One step of `TrackEnv`; the same order of events, the same arithmetic."""
        task, cells, paths = self._task, self._task.num_cells, self._paths
        moved = beliefs.moved(self._group)
        late = clocks.late(task.t_max)
        on = self._rule.sets(clocks, moved)
        on = on[~late[on // cells]]
        action = np.zeros((self._shape[0], cells), dtype=bool)
        action.ravel()[on] = True
        draws = torch.zeros(self._shape, dtype=torch.int64)
        draws[row] = self._moves.at(torch.from_numpy(row), step)
        place = paths.move(place, draws)
        inside, state = paths.inside(place).numpy(), paths.state(place).numpy()
        present = clocks.present & inside
        cell = np.where(inside, state % cells, 0)
        seen = present & (np.take_along_axis(action, cell, axis=1) | late[:, None])
        if self._seen is not None:
            draw = np.ones(self._shape)
            draw[row] = self._seen.at(torch.from_numpy(row), step).numpy()
            seen &= draw < np.where(late[:, None], task.safe_detection[cell], task.detection[cell])
        under_way = present.any(axis=1)
        spent = self._costs.price_of(torch.from_numpy(action))
        spent = torch.where(torch.from_numpy(late), task.safe_cost, spent)
        earned = task.reward * torch.from_numpy(seen).sum(-1)
        reward = (earned - spent * torch.from_numpy(under_way)).float().numpy()
        columns = {"misses": clocks.misses, "action": np.packbits(action, axis=1), "reward": reward}
        # A target that enters is located; it has no part in this step's reward.
        seen |= inside & ~clocks.present
        columns |= {"target": np.where(inside, cell, cells), "located": seen}
        columns["truncated"] = under_way
        self._taken.append({name: column[row] for name, column in columns.items()} | {"row": row})
        if self._kept is not None:
            self._kept.append(moved)
        inside &= ~paths.ended(place).numpy()[:, None]
        reports = inside, seen & inside
        return place, *followed(self._group, clocks, moved, on, state, reports)

    def _episode(self, number: int, start: IndexArray, columns: dict[str, Any]) -> GroupEpisode:
        count = self._task.total_sensors
        # Whether a target was in the grid in the last step, which no exit ended then.
        truncated = bool(columns.pop("truncated")[-1])
        columns["action"] = np.unpackbits(columns["action"], axis=1, count=count).astype(bool)
        return GroupEpisode(
            number=number,
            seed=self._seeds[number],
            policy=0,
            start=start.astype(np.int64),
            terminated=not truncated,
            truncated=truncated,
            belief=self._belief(number, len(columns["reward"])),
            **columns,
        )

    def _belief(self, number: int, steps: int) -> sparse.csr_array | None:
        """`[T · K, M]` beliefs of an episode, predicted in each of its steps."""
        if self._kept is None:
            return None
        targets, cells = self._shape[1], self._task.num_cells
        first, rows, columns, masses = number * targets, list[Any](), list[Any](), list[Any]()
        for t, moved in enumerate(self._kept[:steps]):
            mine = slice(*np.searchsorted(moved.row, [first, first + targets]))
            rows.append(moved.row[mine] - first + t * targets)
            columns.append(moved.state[mine] % cells)
            masses.append(moved.mass[mine].astype(np.float32))
        entries = np.concatenate(masses), (np.concatenate(rows), np.concatenate(columns))
        belief = sparse.csr_array(entries, shape=(steps * targets, cells))
        belief.eliminate_zeros()
        return belief
