"""Paths of the targets of a group: by their motions, or along recorded tracks that are followed together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from trackmdp.arrays.types import BoolArray, IndexArray
from trackmdp.environment.paths import PathSampler, path_sampler
from trackmdp.environment.targets import RecordedTargets, Targets
from trackmdp.motion.chain import Motion
from trackmdp.recordings.together import Together
from trackmdp.seeding import derive
from trackmdp.world.group import Group


class GroupPaths:
    """By their motions a place is a state of `Group.kernel`; along tracks it is one of `Together.places`.

    Args:
        group: the targets.
        device: of the tensors.
        held_out: whether recorded tracks are the held-out ones, or those to learn from.

    Attributes:
        sampler: samples the moves.
        together: which tracks are followed together; None by motions.
        gone: the place of a target that has left.
        waits: whether targets may enter later; until then places are negative.
        offset: `[K]`, the first state of each target's motion.
        states: of a target.
    """

    def __init__(
        self, group: Group, device: torch.device | str = "cpu", *, held_out: bool = False
    ) -> None:
        recorded, self._cells = group.recorded, group.task.num_cells
        self.states, self._modes = group.states, group.modes
        self.together: Together | None = None
        if recorded is None:
            self.sampler = PathSampler(Motion.of(group.kernel), group.kernel.shape[0], device)
        else:
            self.sampler = path_sampler(recorded, device, held_out=held_out)
            tracks = recorded.held_out if held_out else recorded.tracks
            self.together = Together(tracks, len(group))
        self.gone, self.waits = self.sampler.num_states, recorded is not None
        self.offset = torch.as_tensor(group.kind * self.states, device=device)

    def begin(self, rng: torch.Generator) -> Tensor:
        """`[K]`, places at the start of an episode."""
        if self.together is None:
            return torch.randint(self.states, self.offset.shape, generator=rng) + self.offset
        every = self.every()
        return every[int(torch.randint(len(every), (1,), generator=rng))]

    def every(self) -> Tensor:
        """`[G, K]`, places at the start of all of `Together.groups`."""
        assert self.together is not None
        return torch.as_tensor(self.together.places(self.together.groups))

    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        """`[B, K]`, next places of targets in `place` for the `draws` `[B, K]` of the sampler."""
        after = self.sampler.move(self._flat(place), draws.reshape(-1)).view(place.shape)
        return torch.where(place < 0, place + self.gone, after) if self.waits else after

    def inside(self, place: Tensor) -> Tensor:
        """`[B, K]`, whether targets are in the grid."""
        inside = place < self.gone
        return inside & (place >= 0) if self.waits else inside

    def cell(self, place: Tensor) -> Tensor:
        """`[B, K]`, cells of targets; of no meaning where they are not in the grid."""
        if not self.waits:
            return place % self.states // self._modes
        return self.sampler.cell(self._flat(place)).view(place.shape).clamp_max(self._cells - 1)

    def state(self, place: Tensor) -> Tensor:
        """`[B, K]`, states of `Group.kernel`, as `cell`."""
        return self.cell(place) if self.waits else place

    def ended(self, place: Tensor) -> Tensor:
        """`[B]`, whether an episode ends here: no target is in the grid, or none whose recording goes on."""
        stops, inside = self.sampler.stops(self._flat(place)), self.inside(place)
        return ~(inside if stops is None else inside & ~stops.view(place.shape)).any(-1)

    def _flat(self, place: Tensor) -> Tensor:
        """`[B K]`, for the sampler, which knows no targets that are still to enter."""
        return (place.clamp_min(0) if self.waits else place).reshape(-1)


class Walks:
    """Targets of E episodes on their paths, in NumPy; see `solvers/several/simulation.py`.

    Args:
        paths: of the targets.
        place: `[E, K]`, at the start.
        draws: `[R, K]` of the moves of the running episodes `row` `[R]` at a step; None: moves are certain.
    """

    state: IndexArray
    inside: BoolArray

    def __init__(
        self, paths: GroupPaths, place: Tensor, draws: Callable[[Tensor, int], Tensor] | None = None
    ) -> None:
        self._paths, self._draws = paths, draws
        self._stand(place)

    def _stand(self, place: Tensor) -> None:
        self._place, self.state = place, self._paths.state(place).numpy()
        self.inside = self._paths.inside(place).numpy()

    def move(self, row: IndexArray, step: int) -> None:
        """Move all targets; `row` are the episodes still running."""
        drawn = torch.zeros_like(self._place)
        if self._draws is not None:
            rows = torch.from_numpy(row)
            drawn[rows] = self._draws(rows, step)
        self._stand(self._paths.move(self._place, drawn))

    def ended(self) -> BoolArray:
        """`[E]`, whether an episode ends here."""
        return np.asarray(self._paths.ended(self._place))


class TrackMembers(RecordedTargets):
    """Targets of all groups in a row, `[B K]`: each start is that of one, whom others join that overlap with it."""

    def __init__(self, paths: GroupPaths, together: Together, missed: bool) -> None:
        super().__init__(paths.sampler, missed)
        self._together = together

    def _start(self, rows: Tensor) -> Tensor:
        each, number = self._together.count, self._drawn
        wanted = rows.view(-1, each).any(1).nonzero().squeeze(-1)
        place = rows.new_zeros(len(rows) // each, each, dtype=torch.int64)
        points = self.sampler.begin(self._next(len(wanted)))
        for row, point in zip(wanted.tolist(), points.tolist(), strict=True):
            rng = np.random.default_rng(derive(*self._stream, "together", number))
            place[row] = torch.as_tensor(self._together.from_point(point, rng))
            number += 1
        return place.view(-1)


def group_members(paths: GroupPaths, count: int, missed: bool) -> Targets:
    """The targets of `count` groups that follow `paths`, each at the start in a cell of its own motion."""
    if paths.together is not None:
        return TrackMembers(paths, paths.together, missed)
    return Targets(paths.sampler, missed, paths.states, paths.offset.repeat(count))
