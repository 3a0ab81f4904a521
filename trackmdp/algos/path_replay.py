"""A policy that remembers detections, followed along fully sensed paths: to the keys that it has, and on from them.

With all sensors on the target is located at every step, and the keys of a path are those of displacements of one step.
A policy that senses less has others, as frequent as it makes them. So it is replayed from earlier on: after a few
detections of its own its key does not depend on where the replay began.

The worth of a detection over a miss depends on the path, and a key contains only a part of the path: the mean over all
paths with the same key would be wrong for most of them. So both are followed along the path itself. They soon have
detections at the same steps, and then the same keys: from there on both are the same.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.algos.gains import gather
from trackmdp.memory.keys import KeySpace
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


class Replay:
    """A policy on paths with all cells known; reports of sensors that miss are drawn.

    Both a detection and a miss are followed with the same draws, so that they have detections at the same steps.

    Args:
        task: its keys and p_s.
        view: the cells in which the policy may report the target.
        reports: `[keys, T+1, C]`, probability that its sets report each cell, in the local numbers of `view`.
        generator: of the draws.
    """

    def __init__(
        self, task: Task, view: Window, reports: Tensor, generator: torch.Generator
    ) -> None:
        self._keys, self._view, self._reports = task.keys, view, reports.float()
        self._perfect, self._generator = task.perfect and task.safe, generator
        safe = torch.as_tensor(task.safe_detection, dtype=torch.float32, device=reports.device)
        self._safe = pad(safe, (0, 1))

    def _draws(self, paths: Tensor) -> Tensor:
        """`[steps + 1, B]`, a report is made where its probability is above; 0 where all are certain."""
        if self._perfect:
            return torch.zeros_like(paths, dtype=torch.float32)
        return torch.rand(paths.shape, generator=self._generator, device=paths.device)

    @staticmethod
    def settling(keys: KeySpace) -> int:
        """Steps in which a policy makes as many detections as its keys remember, and one more."""
        return (keys.order + 1) * (keys.t_max + 2)

    @staticmethod
    def steps(keys: KeySpace) -> int:
        """Steps of a path: those before it begins, the T + 2 from a located cell to the forced step, those after it.

        A detection that is waited for comes up to t_max + 1 steps later.
        """
        return keys.t_max + 2 + 2 * (Replay.settling(keys) + keys.t_max + 1)

    def begin(self, paths: Tensor, exploring: float = 0.0) -> tuple[Tensor, Tensor]:
        """The paths from a detection of the policy's own on; paths that ended before are left out.

        Args:
            paths: int64 `[steps + 1, B]` keys with all sensors on, the number of keys once outside. One that begins
                with an episode (class 0 of several) is kept from there.
            exploring: share of the paths that are kept from their first key on, whichever it is: without such
                exploring starts a policy would not learn what to do where it seldom comes.

        Returns:
            The keys with all sensors on, as in `paths`, `[later + 1, B']`; and `[T+3, B']` the policy's: first its own
            key, then the keys after a first detection at each step.
        """
        keys, settling = self._keys, self.settling(self._keys)
        cells, last = keys.cell(paths), keys.num_keys - 1
        key = first = paths[0].clamp_max(last)
        misses = torch.zeros_like(key)
        drawn = torch.rand(key.shape, generator=self._generator, device=key.device) < exploring
        starts = drawn | (key % keys.num_classes == 0) & (keys.order > 0)
        begin = torch.where(starts, 0, -1)
        draws = self._draws(paths)
        for step in range(1, settling + keys.t_max + 2):
            found, key, misses = self._step(key, misses, cells[step], draws[step])
            begins = found & (begin < 0) & (step >= settling)
            begin, first = torch.where(begins, step, begin), torch.where(begins, key, first)
        later = len(paths) - settling - keys.t_max - 1
        steps = torch.arange(later, device=paths.device).unsqueeze(1)
        paths = paths.gather(0, begin.clamp_min(0) + steps)
        kept = (begin >= 0) & (paths[0] <= last)
        paths, first = paths[:, kept], first[kept]
        misses, cells = steps[: keys.t_max + 2], paths[: keys.t_max + 3]
        own = torch.cat([first.unsqueeze(0), keys.next(first, misses, keys.cell(cells[1:]))])
        return paths, torch.where(cells <= last, own, last + 1)

    def worth(
        self,
        paths: Tensor,
        own: Tensor,
        spent: Tensor,
        value: Tensor,
        *,
        safe_cost: float,
        discount: float,
    ) -> Tensor:
        """`[T+2, B]` the return after the policy locates the target at each of the steps after the first.

        Args:
            paths: as `begin` returns them.
            own: the keys that it then has, as `begin` returns them.
            spent: `[keys, T+1]` price of the sets.
            value: `[keys]` V, for the time after a detection that does not depend on where the replay began.
            safe_cost: D.
            discount: γ.
        """
        keys, settling, count = self._keys, self.settling(self._keys), self._keys.t_max + 2
        cells, last = keys.cell(paths), keys.num_keys - 1
        key, misses = own[1:].clamp_max(last), torch.zeros_like(own[1:])
        weight = (own[1:] <= last).float()
        worth, draws = torch.zeros_like(weight), self._draws(paths)
        for step in range(1, settling + keys.t_max + 2):
            now = slice(step + 1, step + 1 + count)
            cell = cells[now]
            price = gather(spent, key * (keys.t_max + 1) + misses.clamp_max(keys.t_max))
            forced = misses > keys.t_max
            found, key, misses = self._step(key, misses, cell, draws[now])
            inside = (cell < self._view.num_cells) * weight
            worth = worth + inside * (found.float() - torch.where(forced, safe_cost, price))
            weight = discount * inside
            if step >= settling:
                ends = weight * found
                worth, weight = worth + ends * gather(value, key), weight - ends
        return worth

    def _step(
        self, key: Tensor, misses: Tensor, cell: Tensor, draws: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One move to `cell`: whether the target is located there, and key and misses after it."""
        keys, choices = self._keys, self._reports.shape[1]
        start, last = keys.cell(key), keys.num_keys - 1
        row = key * choices + misses.clamp_max(choices - 1)
        place = row * self._view.width + self._view.index(start, cell)
        chance = gather(self._reports, place) * self._view.contains(start, cell)
        safe = self._safe[cell.clamp_max(self._view.num_cells)]
        found = torch.where(misses >= choices, safe, chance) > draws
        # A target that has left has no key: the value there is discarded.
        after = keys.next(key, misses, cell).clamp_max(last)
        misses = torch.where(found, 0, (misses + 1).clamp_max(choices))
        return found, torch.where(found, after, key), misses
