"""Targets of an environment: the generators of their starts and moves."""

from __future__ import annotations

import torch
from torch import Tensor

from trackmdp.environment.draws import Draw, Streams
from trackmdp.environment.paths import PathSampler, path_sampler
from trackmdp.recordings.tracks import Recorded
from trackmdp.seeding import generator
from trackmdp.world.problem import Problem


class Targets(Streams):
    """Draws for a batch of targets, which start in any of the sampler's starts with equal probability, or in any of M.

    Places of targets are part of the environment's state; this object holds only the generators.

    Args:
        sampler: samples the paths.
        cells: M; None: all starts of the sampler.
        first: `[B]`, of these M states the first one for each target; None: 0.

    Attributes:
        draw: `[B]` int64 draws for the next move of the targets of a mask `[B]`.
        start: `[B]` places of new targets; those of the mask `[B]` are used.
    """

    def __init__(
        self, sampler: PathSampler, cells: int | None = None, first: Tensor | None = None
    ) -> None:
        super().__init__(sampler.device, "motion", "start")
        self.sampler, self._first = sampler, first
        self._starts = sampler.starts if cells is None else cells
        self.start = Draw(self._start, torch.int64, sampler.device)
        self.draw = Draw(self._draw, torch.int64, sampler.device)

    def _start(self, rows: Tensor) -> Tensor:
        # For all rows, so that the start of a row does not depend on the others.
        rng = self.generators["start"]
        start = torch.randint(self._starts, rows.shape, generator=rng, device=self.device)
        return start if self._first is None else start + self._first

    def _draw(self, rows: Tensor) -> Tensor:
        return self.sampler.draw(len(rows), self.generators["motion"])


class RecordedTargets(Targets):
    """Targets on recorded tracks; episodes take the starts in shuffled order, each once in a round.

    Round e is shuffled by the generator (`stream`, "tracks", e).
    """

    def seed(self, seed: int, stream: str) -> None:
        """See `Streams`."""
        self._stream, self._drawn, self._orders = (seed, stream), 0, dict[int, Tensor]()

    def state(self) -> dict[str, Tensor]:
        """Number of episodes that have begun."""
        return {"drawn": torch.tensor(self._drawn, device="cpu")}

    def load_state(self, state: dict[str, Tensor]) -> None:  # type: ignore[override]
        """See `Streams`."""
        self._drawn = int(state["drawn"])

    def _start(self, rows: Tensor) -> Tensor:
        wanted = rows.nonzero().squeeze(-1)
        place = wanted.new_zeros(len(rows))
        # Rows outside the mask use up no start, or tracks would be left out; they stand at point 0, unused.
        place[wanted] = self.sampler.begin(self._next(len(wanted)))
        return place

    def _next(self, count: int) -> Tensor:
        """`[count]` numbers of starts, the next ones in order."""
        # 5 starts, 3 drawn so far, 4 wanted: rounds 0 and 1 are laid end to end and places 3 ... 6 taken. Only the
        # count is saved in a checkpoint; the orders follow from the seed.
        length, begin = self.sampler.starts, self._drawn
        self._drawn = end = begin + count
        first = begin // length
        # Rounds before the first one needed are dropped: at most a few orders are held.
        rounds = range(first, max(end - 1, begin) // length + 1)
        self._orders = {
            each: self._orders[each] if each in self._orders else self._order(each)
            for each in rounds
        }
        return torch.cat(list(self._orders.values()))[begin - first * length : end - first * length]

    def _order(self, number: int) -> Tensor:
        # On the CPU, also if the default device is another: there is one order for all devices.
        rng = generator(*self._stream, "tracks", number)
        return torch.randperm(self.sampler.starts, generator=rng, device="cpu").to(self.device)

    def _draw(self, rows: Tensor) -> Tensor:
        return torch.zeros_like(rows, dtype=torch.int64)  # moves of recorded targets are certain


def make_targets(problem: Problem, device: torch.device) -> Targets:
    """Targets of a world or of recorded tracks."""
    kind = RecordedTargets if isinstance(problem, Recorded) else Targets
    return kind(path_sampler(problem, device))
