"""The policy's own plans followed on fully sensed paths: where they lead, and the gain of a report at each step.

A policy that remembers detections is followed to the keys that it has, and on from them. With all sensors on the target
is located at every step, and the keys of a path are those of displacements of one step.
A policy that senses less has others, as frequent as it makes them. So it is replayed from earlier on: after a few
detections of its own its key does not depend on where the replay began.

The worth of a detection over a miss depends on the path, and a key contains only a part of the path: the mean over all
paths with the same key would be wrong for most of them. So both are followed along the path itself. They soon have
detections at the same steps, and then the same keys: from there on both are the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from trackmdp.algos.gains import Credit, gather, scatter_add
from trackmdp.memory.keys import KeySpace
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


@dataclass(frozen=True)
class Replayed:
    """The policy's own plans followed on every path, as tables for the actor's loss.

    Attributes:
        row: `[T+1, B]`, the place in `[M, T+1]` of the path's first cell.
        entry: `[T+1, B]`, the place in `[M, T+1, K]` of the sensor the target moved to.
        alive: `[T+1, B]`, probability that the target was not yet located where it is in the grid, else 0.
        gain: `[T+1, B]`, of a report there, times `alive`.
        target: `[M, 1]`, mean return of the paths from each cell, the critic's target; where the safe action may miss
            `[M, 2]`, the second of paths with it at the first step.
    """

    row: Tensor
    entry: Tensor
    alive: Tensor
    gain: Tensor
    target: Tensor


class Replay:
    """A policy on paths with all cells known; reports of sensors that miss are drawn.

    Both a detection and a miss are followed with the same draws, so that they have detections at the same steps.

    Args:
        task: its keys.
        view: the cells in which the policy may report the target.
        credit: the discount, and the safe action.
        reports: `[keys, T+1, C]`, probability that its sets report each cell, in the local numbers of `view`.
        prices: `[keys, T+1]`, of the sets.
        generator: of the draws.
    """

    def __init__(
        self,
        task: Task,
        view: Window,
        credit: Credit,
        reports: Tensor,
        prices: Tensor,
        generator: torch.Generator,
    ) -> None:
        self._keys, self._view, self._credit, self._markov = task.keys, view, credit, task.markov
        self._reports, self._prices = reports, prices
        self._perfect, self._generator = task.perfect and task.safe, generator

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
            key, then the keys after a first detection at each step. Both are `paths` where nothing is remembered.
        """
        if self._markov:
            return paths, paths
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

    def worth(self, paths: Tensor, own: Tensor, value: Tensor) -> Tensor:
        """`[T+2, B]` the return after the policy locates the target at each of the steps after the first.

        Args:
            paths: as `begin` returns them.
            own: the keys that it then has, as `begin` returns them.
            value: `[keys]` V, for the time after a detection that does not depend on where the replay began.
        """
        if self._markov:
            return gather(pad(value, (0, 1)), own[1:])
        keys, settling, count = self._keys, self.settling(self._keys), self._keys.t_max + 2
        cells, last = keys.cell(paths), keys.num_keys - 1
        key, misses = own[1:].clamp_max(last), torch.zeros_like(own[1:])
        weight = (own[1:] <= last).float()
        worth, draws = torch.zeros_like(weight), self._draws(paths)
        for step in range(1, settling + keys.t_max + 2):
            now = slice(step + 1, step + 1 + count)
            cell = cells[now]
            price = gather(self._prices, key * (keys.t_max + 1) + misses.clamp_max(keys.t_max))
            forced = misses > keys.t_max
            found, key, misses = self._step(key, misses, cell, draws[now])
            inside = (cell < self._view.num_cells) * weight
            worth = worth + inside * (
                found.float() - torch.where(forced, self._credit.safe_cost, price)
            )
            weight = self._credit.discount * inside
            if step >= settling:
                ends = weight * found
                worth, weight = worth + ends * gather(value, key), weight - ends
        return worth

    def followed(
        self, cells: Tensor, own: Tensor, advantage: Tensor, value: Tensor, blend: float
    ) -> Replayed:
        """The policy's chain from the first cell of each path, until it detects or is forced.

        Args:
            cells: the paths, as `begin` returns them.
            own: the keys that the policy then has.
            advantage: `[T+1, M+1]`, of detecting, the position being revealed after every action.
            value: `[M, 1]` V, or `[M, 2]` V and L.
            blend: λ.
        """
        keys, width, credit = self._keys, self._view.width, self._credit
        m = keys.num_keys
        # [B], [T + 2, B] and [T + 1, B]: the free choices are for the first T + 1 moves, the last one is the forced
        # step.
        start, moves = own[0], cells[1 : keys.t_max + 3]
        end, inside = moves[:-1], moves < m
        clocks = torch.arange(len(end), device=start.device).unsqueeze(-1)
        # clocks [T + 1, 1] broadcasts over paths. With M = K = 4 and T = 1: located in 3, n = 1 is row 7, and the
        # target moving to 2 makes entry 7 * 4 + 2 = 30.
        row = start * len(end) + clocks
        # Where the target has left the grid or the view, `entry` is some other sensor's.
        local = self._view.find(keys.cell(start), keys.cell(end))
        entry, seen = row * width + local.clamp_max(width - 1), local < width
        # [T + 1, B], the probability of a report; 0 or 1 with sensors that never miss.
        reports = gather(self._reports, entry) * seen.float()
        # Set costs are computed once per (x, n) and looked up by the paths, however many there are.
        spent, located = gather(self._prices, row), self.worth(cells, own, value[:, 0])
        missed = value[:, -1]
        returns = credit.returns(reports, inside, spent, located, moves[-1], missed)
        # advantage is [T + 1, M + 1]: entry (n, y) is n (M + 1) + y.
        clocked = gather(advantage, clocks * (m + 1) + end)
        # V(y) - G_{n+1}: located at y now, against the plan's return on the rest of this very path. The target's true
        # cell is known because it was sensed, not from the simulator. lerp(a, b, λ) = a + λ (b - a).
        gain = credit.gain(torch.lerp(clocked, located[:-1] - returns[1:], blend))
        # Clock n is reached if no earlier set of the plan reported; other rows are not states of this policy. The move
        # has to stay in the grid, too: an exit step earns and costs nothing.
        alive, firsts = inside[:-1].float(), [returns[0]]
        for n in range(1, len(alive)):
            alive[n] *= alive[n - 1] * (1.0 - reports[n - 1])
        if value.shape[1] > 1:
            # No set is before the safe action, so that it is the first step of a path.
            steps = (reports[:0], inside[:1], spent[:0], located[:1])
            firsts.append(credit.returns(*steps, moves[0], missed)[0])
        # Cells without a path get the target 0, and with no visits no weight in the critic's loss.
        totals = torch.stack([scatter_add(first, start, m) for first in firsts], dim=1)
        target = totals / torch.bincount(start, minlength=m).clamp(min=1).unsqueeze(-1)
        return Replayed(row, entry, alive, gain * alive * seen, target)

    def _step(
        self, key: Tensor, misses: Tensor, cell: Tensor, draws: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One move to `cell`: whether the target is located there, and key and misses after it."""
        keys, choices = self._keys, self._reports.shape[1]
        start, last = keys.cell(key), keys.num_keys - 1
        row = key * choices + misses.clamp_max(choices - 1)
        place = row * self._view.width + self._view.index(start, cell)
        chance = gather(self._reports, place) * self._view.contains(start, cell)
        safe = self._credit.safe_detection[cell * keys.num_classes]
        found = torch.where(misses >= choices, safe, chance) > draws
        # A target that has left has no key: the value there is discarded.
        after = keys.next(key, misses, cell).clamp_max(last)
        misses = torch.where(found, 0, (misses + 1).clamp_max(choices))
        return found, torch.where(found, after, key), misses
