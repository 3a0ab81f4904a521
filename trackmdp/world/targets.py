"""Where the targets of an environment come from: sampled from a kernel, or replayed from recorded tracks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from trackmdp.seeding import generator
from trackmdp.world.draws import Draw
from trackmdp.world.model import World
from trackmdp.world.modes import HiddenWorld, Modelled
from trackmdp.world.motion import Motion
from trackmdp.world.tracks import Problem, Recorded, Tracks


class Targets(Protocol):
    """A batch of targets. Their positions are in the environment's state; this object holds only the generators."""

    def seed(self, seed: int, stream: str) -> None:
        """Begin the draws of a seed and a stream."""
        ...

    def state(self) -> dict[str, Tensor]:
        """State of the generators, for a checkpoint."""
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken."""
        ...

    def start(self, rows: Tensor) -> dict[str, Tensor]:
        """`target`, and what else a move depends on, `[B]` of fresh targets, of which the mask `rows` `[B]` is used."""
        ...

    def draw(self, rows: Tensor) -> Tensor:
        """The random numbers for the next move of the targets `rows` `[B]`; empty where moves are not random."""
        ...

    def move(self, state: Mapping[str, Tensor], draws: Tensor) -> dict[str, Tensor]:
        """The same after one move; a target of M has exited."""
        ...

    def cut(self, moved: Mapping[str, Tensor]) -> Tensor | None:
        """`[B]` whether the recording stops after this move (the episode is truncated); None if it never does."""
        ...


def make_targets(setting: Problem, device: torch.device) -> Targets:
    """The targets of a world or of recorded tracks."""
    if isinstance(setting, World):
        return SampledTargets(setting, device)
    return HiddenTargets(setting, device) if isinstance(setting, HiddenWorld) else RecordedTargets(setting, device)


class SampledTargets:
    """Targets that move as the kernel says; they start uniformly over the cells."""

    def __init__(self, world: Modelled, device: torch.device) -> None:
        self._cells, self._device = world.kernel.shape[0], device
        self._motion = Motion(world.kernel, device)
        self._start = Draw(self._start_of, torch.int64, device)
        self._draw = Draw(self._draw_of, torch.float64, device)

    def seed(self, seed: int, stream: str) -> None:
        """The generators are those called (`stream`, "motion") and (`stream`, "start")."""
        self._generators = {name: generator(seed, stream, name, device=self._device) for name in ("motion", "start")}

    def state(self) -> dict[str, Tensor]:
        """See `Targets`."""
        return {name: rng.get_state() for name, rng in self._generators.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Targets`."""
        for name, rng in self._generators.items():
            # A checkpoint read for a GPU has all its tensors there; a generator's state is on the CPU at all times.
            rng.set_state(state[name].cpu())

    def start(self, rows: Tensor) -> dict[str, Tensor]:
        """See `Targets`; draws for all rows, so that what a row gets does not depend on the others."""
        return {"target": self._start(rows)}

    def _start_of(self, rows: Tensor) -> Tensor:
        return torch.randint(self._cells, rows.shape, generator=self._generators["start"], device=self._device)

    def draw(self, rows: Tensor) -> Tensor:
        """`[B]` uniform draws."""
        return self._draw(rows)

    def _draw_of(self, rows: Tensor) -> Tensor:
        return self._motion.draw(len(rows), self._generators["motion"])

    def move(self, state: Mapping[str, Tensor], draws: Tensor) -> dict[str, Tensor]:
        """See `Targets`."""
        return {"target": self._motion.move(state["target"], draws)}

    def cut(self, moved: Mapping[str, Tensor]) -> None:
        """See `Targets`."""


class HiddenTargets(SampledTargets):
    """Targets with a mode: `state`, beside `target`, is the cell and the mode; all are as likely to start."""

    def __init__(self, world: HiddenWorld, device: torch.device) -> None:
        super().__init__(world, device)
        self._modes = world.modes

    def start(self, rows: Tensor) -> dict[str, Tensor]:
        """See `Targets`."""
        return self._shown(super().start(rows)["target"])

    def move(self, state: Mapping[str, Tensor], draws: Tensor) -> dict[str, Tensor]:
        """See `Targets`."""
        return self._shown(self._motion.move(state["state"], draws))

    def _shown(self, state: Tensor) -> dict[str, Tensor]:
        # The exit is state M · H, and so cell M.
        return {"target": state // self._modes, "state": state}


class RecordedTargets:
    """Targets that go along recorded tracks.

    Episodes begin at the starts in shuffled order, each once before any comes again: the first cells of the tracks, or
    all recorded points. `point` is the place on the line that all tracks, each closed by the exit, form end to end.
    """

    def __init__(self, setting: Recorded, device: torch.device) -> None:
        cells, following, starts, cut = _line(setting.tracks, setting.num_cells, anywhere=setting.anywhere)
        self._cells, self._following, self._starts, self._cut = (
            torch.as_tensor(part, device=device) for part in (cells, following, starts, cut)
        )
        self._device, self._drawn = device, 0
        self._start = Draw(self._start_of, torch.int64, device)

    def seed(self, seed: int, stream: str) -> None:
        """The e-th order of the starts comes from the generator called (`stream`, "tracks", e)."""
        self._names = (seed, stream)
        self._drawn, self._orders = 0, dict[int, Tensor]()

    def state(self) -> dict[str, Tensor]:
        """How many episodes have begun."""
        return {"drawn": torch.tensor(self._drawn, device="cpu")}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Targets`."""
        self._drawn = int(state["drawn"])

    def start(self, rows: Tensor) -> dict[str, Tensor]:
        """See `Targets`."""
        point = self._start(rows)
        return {"target": self._cells[point], "point": point}

    def _start_of(self, rows: Tensor) -> Tensor:
        wanted = rows.nonzero().squeeze(-1)
        point = self._starts.new_zeros(len(rows))
        # Rows that are not wanted use up no start, or tracks would be left out; they stand at point 0, unused.
        point[wanted] = self._next(len(wanted))
        return point

    def _next(self, count: int) -> Tensor:
        """`[count]` starts, the next ones in order."""
        if count == 0:
            return self._starts[:0]
        length = len(self._starts)
        # 5 starts, 3 drawn so far, 4 wanted: rounds 0 and 1 are laid end to end and places 3 ... 6 taken. Only the
        # count is saved in a checkpoint; the orders follow from the seed.
        begin, end = self._drawn, self._drawn + count
        rounds = range(begin // length, (end - 1) // length + 1)
        # Rounds before the first one needed are dropped: at most a few orders are held.
        self._orders = {
            number: self._orders[number] if number in self._orders else self._order(number) for number in rounds
        }
        self._drawn = end
        offset = rounds[0] * length
        return torch.cat(list(self._orders.values()))[begin - offset : end - offset]

    def _order(self, number: int) -> Tensor:
        seed, stream = self._names
        rng = generator(seed, stream, "tracks", number)
        # On the CPU, whatever the default device is: there is one order for all devices.
        order = torch.randperm(len(self._starts), generator=rng, device="cpu")
        return self._starts[order.to(self._device)]

    def draw(self, rows: Tensor) -> Tensor:  # noqa: ARG002
        """Empty: a recorded target's next move is known."""
        return torch.empty(0, device=self._device)

    def move(self, state: Mapping[str, Tensor], draws: Tensor) -> dict[str, Tensor]:  # noqa: ARG002
        """See `Targets`."""
        point = self._following[state["point"]]
        return {"target": self._cells[point], "point": point}

    def cut(self, moved: Mapping[str, Tensor]) -> Tensor:
        """Where the recording stops."""
        return self._cut[moved["point"]]


def _line(tracks: Tracks, num_cells: int, *, anywhere: bool) -> tuple[np.ndarray, ...]:
    """All tracks end to end, the exit closing those that have one.

    Returns:
        `[P]` cells, M for an exit; `[P]` the point after each; the points where episodes may start; `[P]` bool, where a
        recording stops without an exit.
    """
    # Track 3 4, which exits, and track 7 8, which stops: cells 3 4 M 7 8, following 1 2 2 4 4 (the last point of a
    # track stays where it is), cut at point 4, starts 0 and 3. With `anywhere` episodes may start at 0, 1 and 3:
    # neither at an exit, nor where no next step is known.
    closed = tracks.closed(num_cells)
    last = closed.first[1:] - 1
    following = np.arange(len(closed.cells)) + 1
    following[last] = last
    cut = np.zeros(len(closed.cells), dtype=bool)
    cut[last] = ~tracks.exits
    starts = closed.first[:-1]
    if anywhere:
        starts = np.flatnonzero((closed.cells < num_cells) & ~cut)
    return closed.cells, following, starts, cut
