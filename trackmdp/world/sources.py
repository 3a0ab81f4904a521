"""Where targets go: by draws of the kernel, or along recorded tracks; batched, and without a generator of their own.

A place, int64, is the full state of a target: its cell, the cell and the mode, or a point of a track.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from trackmdp.world.modes import HiddenWorld, Modelled
from trackmdp.world.motion import Motion
from trackmdp.world.tracks import Problem, Recorded, Tracks


class Sampled:
    """Targets that move as the kernel says; a place is a cell, or with modes cell · H + mode. All are starts.

    Attributes:
        starts: how many places to start in there are.
        device: where the tensors live.
    """

    def __init__(self, world: Modelled, device: torch.device) -> None:
        self.starts, self.device, self._motion = world.kernel.shape[0], device, Motion(world.kernel, device)
        self._modes = world.modes if isinstance(world, HiddenWorld) else 1

    def begin(self, numbers: Tensor) -> Tensor:
        """`[B]` places of the starts `numbers` `[B]`."""
        return numbers

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`[count]` float64 draws, each for one move of one target."""
        return self._motion.draw(count, generator)

    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        """`[B]` places after one move."""
        return self._motion.move(place, draws)

    def cell(self, place: Tensor) -> Tensor:
        """`[B]` cells; M for a target that has exited, which is in the place behind all others."""
        return place if self._modes == 1 else place // self._modes

    def mode(self, place: Tensor) -> Tensor | None:
        """`[B]` modes, -1 for a target that has exited; None where targets have none."""
        return None if self._modes == 1 else torch.where(place < self.starts, place % self._modes, -1)

    def stops(self, place: Tensor) -> Tensor | None:  # noqa: ARG002
        """`[B]` bool, whether the recording stops here with the target still in the grid; None if it never does."""
        return None


class Replayed:
    """Targets that go along recorded tracks; methods as those of `Sampled`.

    A place is a point of the line that all tracks, each closed by the exit, form end to end. Starts are the first cells
    of the tracks, or with `anywhere` all recorded points.
    """

    def __init__(self, tracks: Tracks, num_cells: int, device: torch.device, *, anywhere: bool = False) -> None:
        # Track 3 4, which exits, and track 7 8, which stops: cells 3 4 M 7 8, following 1 2 2 4 4 (the last point of a
        # track stays where it is), stops at point 4, starts 0 and 3. With `anywhere` episodes may start at 0, 1 and 3:
        # neither at an exit, nor where no next step is known.
        line = tracks.closed(num_cells)
        last, following = line.first[1:] - 1, np.arange(len(line.cells)) + 1
        following[last] = last
        stops = np.zeros(len(line.cells), dtype=bool)
        stops[last] = ~tracks.exits
        begins = np.flatnonzero((line.cells < num_cells) & ~stops) if anywhere else line.first[:-1]
        self.starts, self.device = len(begins), device
        self._cells, self._following, self._begins, self._stops = (
            torch.as_tensor(part, device=device) for part in (line.cells, following, begins, stops)
        )

    def begin(self, numbers: Tensor) -> Tensor:
        """See `Sampled`."""
        return self._begins[numbers]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:  # noqa: ARG002
        """See `Sampled`."""
        return torch.zeros(count, dtype=torch.float64, device=self.device)  # a recorded path needs none

    def move(self, place: Tensor, draws: Tensor) -> Tensor:  # noqa: ARG002
        """See `Sampled`."""
        return self._following[place]

    def cell(self, place: Tensor) -> Tensor:
        """See `Sampled`."""
        return self._cells[place]

    def mode(self, place: Tensor) -> None:
        """See `Sampled`."""

    def stops(self, place: Tensor) -> Tensor:
        """See `Sampled`."""
        return self._stops[place]


Source: TypeAlias = Sampled | Replayed


def held_out_source(problem: Problem) -> Source:
    """What a policy is judged by: the motion of a world, or the held-out ones of recorded tracks."""
    cpu = torch.device("cpu")
    if isinstance(problem, Recorded):
        return Replayed(problem.held_out, problem.num_cells, cpu)
    return Sampled(problem, cpu)
