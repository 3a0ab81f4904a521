"""The targets of an environment: where they go (`sources`), and the generators of their starts and moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor

from trackmdp.seeding import generator
from trackmdp.world.draws import Draw
from trackmdp.world.modes import HiddenWorld, Modelled
from trackmdp.world.sources import Replayed, Sampled, Source
from trackmdp.world.tracks import Problem, Recorded


def make_targets(problem: Problem, device: torch.device) -> Targets:
    """The targets of a world or of recorded tracks."""
    return RecordedTargets(problem, device) if isinstance(problem, Recorded) else SampledTargets(problem, device)


class Targets(ABC):
    """A batch of targets. Their places are in the environment's state; this object holds only the generators.

    Args:
        source: where they go.
        key: under which name the environment keeps their places; "target", the cell, where the two are the same.
    """

    def __init__(self, source: Source, key: str) -> None:
        self.source, self._key = source, key
        self._starts = Draw(self._start_of, torch.int64, source.device)
        self._draws = Draw(self._draw_of, torch.float64, source.device)

    @abstractmethod
    def seed(self, seed: int, stream: str) -> None:
        """Begin the draws of a seed and a stream."""

    @abstractmethod
    def state(self) -> dict[str, Tensor]:
        """State of the generators, for a checkpoint."""

    @abstractmethod
    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken."""

    @abstractmethod
    def _start_of(self, rows: Tensor) -> Tensor:
        """`[B]` places of fresh targets, of which the mask `rows` `[B]` is used."""

    @abstractmethod
    def _draw_of(self, rows: Tensor) -> Tensor:
        """The random numbers for the next move of the targets `rows` `[B]`."""

    def start(self, rows: Tensor) -> dict[str, Tensor]:
        """`target`, and what else a move depends on, `[B]` of fresh targets, of which the mask `rows` `[B]` is used."""
        return self._known(self._starts(rows))

    def draw(self, rows: Tensor) -> Tensor:
        """The random numbers for the next move of the targets `rows` `[B]`."""
        return self._draws(rows)

    def move(self, state: Mapping[str, Tensor], draws: Tensor) -> dict[str, Tensor]:
        """The same as of `start` after one move; a target of M has exited."""
        return self._known(self.source.move(state[self._key], draws))

    def mode(self, state: Mapping[str, Tensor]) -> Tensor | None:
        """`[B]` the targets' modes, -1 of one that has exited; None where they have none."""
        return self.source.mode(state[self._key])

    def cut(self, moved: Mapping[str, Tensor]) -> Tensor | None:
        """`[B]` whether the recording stops after this move (the episode is truncated); None if it never does."""
        return self.source.stops(moved[self._key])

    def _known(self, place: Tensor) -> dict[str, Tensor]:
        return {"target": self.source.cell(place), self._key: place}


class SampledTargets(Targets):
    """Targets that move as the kernel says; they start uniformly over the cells, or over cells and modes."""

    def __init__(self, world: Modelled, device: torch.device) -> None:
        super().__init__(Sampled(world, device), "place" if isinstance(world, HiddenWorld) else "target")

    def seed(self, seed: int, stream: str) -> None:
        """The generators are those called (`stream`, "motion") and (`stream`, "start")."""
        device = self.source.device
        self._generators = {name: generator(seed, stream, name, device=device) for name in ("motion", "start")}

    def state(self) -> dict[str, Tensor]:
        """See `Targets`."""
        return {name: rng.get_state() for name, rng in self._generators.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Targets`."""
        for name, rng in self._generators.items():
            # A checkpoint read for a GPU has all its tensors there; a generator's state is on the CPU at all times.
            rng.set_state(state[name].cpu())

    def _start_of(self, rows: Tensor) -> Tensor:
        # For all rows, so that what a row gets does not depend on the others.
        return torch.randint(
            self.source.starts, rows.shape, generator=self._generators["start"], device=self.source.device
        )

    def _draw_of(self, rows: Tensor) -> Tensor:
        return self.source.draw(len(rows), self._generators["motion"])


class RecordedTargets(Targets):
    """Targets that go along recorded tracks; episodes begin at the starts in shuffled order, each once in a round.

    The e-th order of the starts comes from the generator called (`stream`, "tracks", e).
    """

    def __init__(self, problem: Recorded, device: torch.device) -> None:
        super().__init__(Replayed(problem.tracks, problem.num_cells, device, anywhere=problem.anywhere), "place")

    def seed(self, seed: int, stream: str) -> None:
        """See `Targets`."""
        self._names, self._drawn, self._orders = (seed, stream), 0, dict[int, Tensor]()

    def state(self) -> dict[str, Tensor]:
        """How many episodes have begun."""
        return {"drawn": torch.tensor(self._drawn, device="cpu")}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Targets`."""
        self._drawn = int(state["drawn"])

    def _start_of(self, rows: Tensor) -> Tensor:
        wanted = rows.nonzero().squeeze(-1)
        place = wanted.new_zeros(len(rows))
        # Rows that are not wanted use up no start, or tracks would be left out; they stand at point 0, unused.
        place[wanted] = self.source.begin(self._next(len(wanted)))
        return place

    def _next(self, count: int) -> Tensor:
        """`[count]` numbers of starts, the next ones in order."""
        # 5 starts, 3 drawn so far, 4 wanted: rounds 0 and 1 are laid end to end and places 3 ... 6 taken. Only the
        # count is saved in a checkpoint; the orders follow from the seed.
        length, begin = self.source.starts, self._drawn
        self._drawn = end = begin + count
        first = begin // length
        # Rounds before the first one needed are dropped: at most a few orders are held.
        rounds = range(first, max(end - 1, begin) // length + 1)
        self._orders = {each: self._orders[each] if each in self._orders else self._order(each) for each in rounds}
        return torch.cat(list(self._orders.values()))[begin - first * length : end - first * length]

    def _order(self, number: int) -> Tensor:
        # On the CPU, whatever the default device is: there is one order for all devices.
        order = torch.randperm(self.source.starts, generator=generator(*self._names, "tracks", number), device="cpu")
        return order.to(self.source.device)

    def _draw_of(self, rows: Tensor) -> Tensor:
        return torch.zeros(rows.shape, dtype=torch.float64, device=rows.device)  # a recorded target's move is known
