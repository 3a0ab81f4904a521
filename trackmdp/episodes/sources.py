"""Where the targets of episodes go: each by the draws of its own generator, or along a recorded track."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from trackmdp.world.model import World
from trackmdp.world.modes import HiddenWorld, Modelled
from trackmdp.world.motion import Motion
from trackmdp.world.tracks import Problem, Recorded


class Source(ABC):
    """The targets of a problem; a place, int64, is the full state of a target, by default its cell."""

    @abstractmethod
    def start(self, generators: Sequence[torch.Generator]) -> Tensor:
        """`[B]` places in which the targets start, one draw from each generator."""

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`[count]` float64 draws, one for each of an episode's next moves."""

    @abstractmethod
    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        """`[B]` places after one move."""

    def cell(self, place: Tensor) -> Tensor:
        """`[B]` cells; M for a target that has exited."""
        return place

    def mode(self, place: Tensor) -> Tensor | None:  # noqa: ARG002
        """`[B]` modes, -1 for a target that has exited; None where targets have none."""
        return None

    def stops(self, place: Tensor) -> Tensor:
        """`[B]` bool, whether the recording stops here with the target still in the grid."""
        return torch.zeros_like(place, dtype=torch.bool)


class _Sampled(Source):
    """Targets that move as the kernel says, from a uniform start; a place is a cell."""

    def __init__(self, world: Modelled) -> None:
        self._cells, self._motion = world.kernel.shape[0], Motion(world.kernel)

    def start(self, generators: Sequence[torch.Generator]) -> Tensor:
        return torch.cat([torch.randint(self._cells, (1,), generator=rng) for rng in generators])

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        return self._motion.draw(count, generator)

    def move(self, place: Tensor, draws: Tensor) -> Tensor:
        return self._motion.move(place, draws)


class _Hidden(_Sampled):
    """The same of targets with a hidden mode; a place is the cell and the mode."""

    def __init__(self, world: HiddenWorld) -> None:
        super().__init__(world)
        self._modes, self._states = world.modes, world.num_states

    def cell(self, place: Tensor) -> Tensor:
        return place // self._modes

    def mode(self, place: Tensor) -> Tensor | None:
        return torch.where(place < self._states, place % self._modes, -1)


class _Replayed(Source):
    """Targets that go along held-out tracks, drawn with replacement, from their first cell on.

    A place is an index into the cells of all tracks end to end, each track that exits being closed by cell M.
    """

    def __init__(self, problem: Recorded) -> None:
        line = problem.held_out.closed(problem.num_cells)
        self._line, self._first = torch.as_tensor(line.cells), torch.as_tensor(line.first[:-1])
        stops = np.zeros(len(line.cells), dtype=bool)
        # Example: the tracks 3 4 (exit) and 7 8 (cut) are cells = 3 4 M 7 8, first = 0 3 5. The last places are 2 and
        # 4; only at 4 the recording stops with the target in the grid.
        stops[line.first[1:] - 1] = ~line.exits
        self._stops = torch.as_tensor(stops)

    def start(self, generators: Sequence[torch.Generator]) -> Tensor:
        return self._first[torch.cat([torch.randint(len(self._first), (1,), generator=rng) for rng in generators])]

    def draw(self, count: int, generator: torch.Generator) -> Tensor:  # noqa: ARG002
        return torch.zeros(count, dtype=torch.float64)  # a recorded path needs none

    def move(self, place: Tensor, draws: Tensor) -> Tensor:  # noqa: ARG002
        return place + 1  # an episode ends at the last place of its track

    def cell(self, place: Tensor) -> Tensor:
        return self._line[place]

    def stops(self, place: Tensor) -> Tensor:
        return self._stops[place]


def source_of(problem: Problem) -> Source:
    """The targets of a world or of recorded tracks."""
    if isinstance(problem, HiddenWorld):
        return _Hidden(problem)
    return _Sampled(problem) if isinstance(problem, World) else _Replayed(problem)
