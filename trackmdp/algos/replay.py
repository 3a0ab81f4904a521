"""A policy that remembers detections, followed along fully sensed paths: to the keys that it has, and on from them.

With all sensors on the target is located at every step, and the keys of a path are those of displacements of one step.
A policy that senses less has others, as frequent as it makes them. So it is replayed from earlier on: after a few
detections of its own its key does not depend on where the replay began.

What a detection is worth more than a miss depends on the path, of which a key tells only a part: the mean over all
paths with the same key would be wrong for most of them. So both are followed along the path itself. They soon have
detections at the same steps, and then the same keys: what comes later is the same for both.
"""

from __future__ import annotations

import torch
from torch import Tensor

from trackmdp.algos.gains import gather
from trackmdp.world.memory import KeySpace
from trackmdp.world.windows import Window


class Replay:
    """A policy on paths whose cells are all known.

    Args:
        keys: how its keys are numbered.
        view: the sensors that it may switch on.
        on: bool `[keys, T+1, K]`, the policy, its sensors in the local numbers of `view`.
    """

    def __init__(self, keys: KeySpace, view: Window, on: Tensor) -> None:
        self._keys, self._view, self._on = keys, view, on

    @staticmethod
    def settling(keys: KeySpace) -> int:
        """Steps in which a policy makes as many detections as its keys remember, and one more."""
        return (keys.order + 1) * (keys.t_max + 2)

    @staticmethod
    def steps(keys: KeySpace) -> int:
        """Steps of a path: those before it begins, the T + 2 from a located cell to the forced step, those after it.

        A detection that is waited for comes up to t_max + 1 steps later.
        """
        return keys.t_max + 2 + (2 * (Replay.settling(keys) + keys.t_max + 1) if keys.order else 0)

    def begin(self, paths: Tensor) -> tuple[Tensor, Tensor]:
        """The paths from a detection of the policy's own on; those that ended before are left out.

        Args:
            paths: int64 `[steps + 1, B]` keys with all sensors on, the number of keys once outside. One that begins
                with an episode (class 0) is kept from there.

        Returns:
            The keys with all sensors on, as in `paths`, `[later + 1, B']`; and `[T+3, B']` the policy's: at first that
            which it has, then those that a first detection at each step would leave.
        """
        keys, settling = self._keys, self.settling(self._keys)
        cells, last = keys.cell(paths), keys.num_keys - 1
        key = first = paths[0].clamp_max(last)
        misses = torch.zeros_like(key)
        begin = torch.where(key % keys.num_classes == 0, 0, -1)
        for step in range(1, settling + keys.t_max + 2):
            found, key, misses = self._step(key, misses, cells[step])
            begins = found & (begin < 0) & (step >= settling)
            begin, first = torch.where(begins, step, begin), torch.where(begins, key, first)
        later = len(paths) - settling - keys.t_max - 1
        paths = paths.gather(0, begin.clamp_min(0) + torch.arange(later, device=paths.device).unsqueeze(1))
        kept = (begin >= 0) & (paths[0] <= last)
        paths, first = paths[:, kept], first[kept]
        misses = torch.arange(keys.t_max + 2, device=paths.device).unsqueeze(1)
        cells = paths[: keys.t_max + 3]
        own = torch.cat([first.unsqueeze(0), keys.next(first, misses, keys.cell(cells[1:]))])
        return paths, torch.where(cells <= last, own, last + 1)

    def worth(
        self, paths: Tensor, own: Tensor, spent: Tensor, value: Tensor, *, safe: float, discount: float
    ) -> Tensor:
        """`[T+2, B]` what follows where the policy is located, at each of the steps after the first.

        Args:
            paths: as `begin` returns them.
            own: the keys that it then has, as `begin` returns them.
            spent: `[keys, T+1]` price of the sets.
            value: `[keys]` V, for what follows a detection when that no longer depends on where the replay began.
            safe: what the forced step earns, r - D.
            discount: γ.
        """
        keys, settling, count = self._keys, self.settling(self._keys), self._keys.t_max + 2
        cells, last = keys.cell(paths), keys.num_keys - 1
        key, misses = own[1:].clamp_max(last), torch.zeros_like(own[1:])
        weight = (own[1:] <= last).float()
        worth = torch.zeros_like(weight)
        for step in range(1, settling + keys.t_max + 2):
            cell = cells[step + 1 : step + 1 + count]
            price = gather(spent, key * (keys.t_max + 1) + misses.clamp_max(keys.t_max))
            forced = misses > keys.t_max
            found, key, misses = self._step(key, misses, cell)
            inside = (cell < self._view.num_cells) * weight
            worth = worth + inside * torch.where(forced, safe, found.float() - price)
            weight = discount * inside
            if step >= settling:
                ends = weight * found
                worth, weight = worth + ends * gather(value, key), weight - ends
        return worth

    def _step(self, key: Tensor, misses: Tensor, cell: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One move to `cell`: whether the target is located there, and key and misses after it."""
        keys, choices = self._keys, self._on.shape[1]
        start, last = keys.cell(key), keys.num_keys - 1
        place = (key * choices + misses.clamp_max(choices - 1)) * self._view.width + self._view.index(start, cell)
        found = (misses >= choices) | (gather(self._on, place) & self._view.contains(start, cell))
        # A target that has left has no key: whatever stands there is thrown away.
        after = keys.next(key, misses, cell).clamp_max(last)
        return found, torch.where(found, after, key), torch.where(found, 0, misses + 1)
