"""Paths of the targets of a group: by their motions, or along recorded tracks that are followed together."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from trackmdp.environment.paths import PathSampler, path_sampler
from trackmdp.environment.targets import RecordedTargets, Targets
from trackmdp.recordings.together import Together
from trackmdp.recordings.tracks import Recorded
from trackmdp.seeding import derive
from trackmdp.world.group import Group


class GroupPaths:
    """By their motions; a place is a state of `Group.kernel`.

    Args:
        group: the targets.
        device: of the tensors.

    Attributes:
        sampler: samples the moves.
        gone: the place of a target that has left.
        waits: whether targets may enter later.
    """

    waits = False

    def __init__(self, group: Group, device: torch.device | str = "cpu") -> None:
        self.sampler = PathSampler(group.kernel, device=device)
        self.gone, self.cells = self.sampler.num_states, group.task.num_cells
        self.offset = torch.as_tensor(group.kind * self.cells, device=device)

    def begin(self, rng: torch.Generator) -> Tensor:
        """`[K]`, places at the start of an episode."""
        return torch.randint(self.cells, self.offset.shape, generator=rng) + self.offset

    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        """`[B, K]`, next places of targets in `place` for the `draws` `[B, K]` of the sampler."""
        return self.sampler.move(place.reshape(-1), draws.reshape(-1)).view(place.shape)

    def inside(self, place: Tensor) -> Tensor:
        """`[B, K]`, whether targets are in the grid."""
        return place < self.gone

    def cell(self, place: Tensor) -> Tensor:
        """`[B, K]`, cells of targets; of no meaning where they are not in the grid."""
        return place % self.cells

    def state(self, place: Tensor) -> Tensor:
        """`[B, K]`, states of `Group.kernel`, as `cell`."""
        return place

    def ended(self, place: Tensor) -> Tensor:
        """`[B]`, whether an episode ends here: no target is in the grid, or none whose recording goes on."""
        return ~self.inside(place).any(-1)


class AlongTracks(GroupPaths):
    """Along tracks of a recording, those to learn from or the held-out ones; places are those of `together`."""

    waits = True

    def __init__(
        self, recorded: Recorded, count: int, device: torch.device | str = "cpu", *, held_out: bool
    ) -> None:
        self.sampler = path_sampler(recorded, device, held_out=held_out)
        self.gone, self.cells = self.sampler.num_states, recorded.num_cells
        self.together = Together(recorded.held_out if held_out else recorded.tracks, count)

    def begin(self, rng: torch.Generator) -> Tensor:
        """See `GroupPaths`; one of `Together.groups`."""
        groups = self.together.groups
        number = int(torch.randint(len(groups), (1,), generator=rng))
        return torch.as_tensor(self.together.places(groups[number : number + 1])[0])

    def every(self) -> Tensor:
        """`[G, K]`, places at the start of all of `Together.groups`."""
        return torch.as_tensor(self.together.places(self.together.groups))

    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        """See `GroupPaths`."""
        after = super().move(place.clamp_min(0), draws)
        return torch.where(place < 0, place + self.gone, after)

    def inside(self, place: Tensor) -> Tensor:
        """See `GroupPaths`."""
        return (place >= 0) & (place < self.gone)

    def cell(self, place: Tensor) -> Tensor:
        """See `GroupPaths`."""
        cell = self.sampler.cell(place.clamp_min(0).reshape(-1)).view(place.shape)
        return cell.clamp_max(self.cells - 1)

    state = cell

    def ended(self, place: Tensor) -> Tensor:
        """See `GroupPaths`."""
        stops = self.sampler.stops(place.clamp_min(0).reshape(-1))
        assert stops is not None
        return ~(self.inside(place) & ~stops.view(place.shape)).any(-1)


def group_paths(
    group: Group, device: torch.device | str = "cpu", *, held_out: bool = False
) -> GroupPaths:
    """By the motions of a group, or along its recorded tracks: those to learn from, or on request the held-out ones."""
    if group.recorded is None:
        return GroupPaths(group, device)
    return AlongTracks(group.recorded, len(group), device, held_out=held_out)


class Members(Targets):
    """Targets of all groups in a row, `[B K]`, each in a cell of its own motion at the start."""

    def __init__(self, paths: GroupPaths, count: int) -> None:
        super().__init__(paths.sampler)
        self._cells, self._offset = paths.cells, paths.offset.repeat(count)

    def _start(self, rows: Tensor) -> Tensor:
        rng = self.generators["start"]
        cell = torch.randint(self._cells, rows.shape, generator=rng, device=self.device)
        return cell + self._offset


class TrackMembers(RecordedTargets):
    """Targets of all groups in a row, `[B K]`: each start is that of one, whom others join that overlap with it."""

    def __init__(self, paths: AlongTracks) -> None:
        super().__init__(paths.sampler)
        self._together = paths.together

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


def group_members(paths: GroupPaths, count: int) -> Targets:
    """The targets of `count` groups that follow `paths`."""
    return TrackMembers(paths) if isinstance(paths, AlongTracks) else Members(paths, count)
