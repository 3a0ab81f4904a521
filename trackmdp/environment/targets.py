"""Targets of an environment: the generators of their starts, moves and reports.

They have the same numbers under `torch.compile` as without it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import torch
from torch import Tensor, library

from trackmdp.environment.paths import PathSampler
from trackmdp.seeding import generator

_TARGETS: WeakValueDictionary[int, Targets] = WeakValueDictionary()
"""Number -> targets: a graph can hold a number, but no generator."""

_numbers = itertools.count()


# `turn` is never written to. Because it might be, the compiler does not merge, drop or swap two draws.
@library.custom_op("trackmdp::draw", mutates_args={"turn"})
def _draw(number: int, name: str, rows: Tensor, turn: Tensor, dtype: torch.dtype) -> Tensor:  # noqa: ARG001
    # As without the compiler: nothing is drawn for no row.
    if not bool(rows.any()):
        return torch.zeros(rows.shape, dtype=dtype, device=rows.device)
    drawn: Tensor = getattr(_TARGETS[number], name)(rows)
    return drawn


@_draw.register_fake
def _(number: int, name: str, rows: Tensor, turn: Tensor, dtype: torch.dtype) -> Tensor:  # noqa: ARG001
    return torch.empty(rows.shape, dtype=dtype, device=rows.device)


class Targets:
    """Draws for a batch of targets, which start in any of the sampler's starts with equal probability, or in any of M.

    Places of targets are part of the environment's state; this object holds only the generators.

    TorchDynamo cannot put a call with a `torch.Generator` into a graph (torch 2.13: "Failed to convert args/kwargs to
    proxy", gb0055), and breaks the graph in two around it. There a draw is an operator of its own, which the compiler
    does not trace.

    Args:
        sampler: samples the paths.
        missed: whether reports are drawn.
        cells: M; None: all starts of the sampler.
        first: `[B]`, of these M states the first one for each target; None: 0.
    """

    _names: ClassVar[tuple[str, ...]] = ("motion", "start")

    def __init__(
        self,
        sampler: PathSampler,
        missed: bool,
        cells: int | None = None,
        first: Tensor | None = None,
    ) -> None:
        self.sampler, self._first, self._device = sampler, first, sampler.device
        self._starts = sampler.starts if cells is None else cells
        self._generators: dict[str, torch.Generator] = {}
        self._missed, self._turn = missed, torch.zeros((), device=self._device)
        self._register()

    def _register(self) -> None:
        self._number = next(_numbers)
        _TARGETS[self._number] = self

    def _of(self, name: str, rows: Tensor, dtype: torch.dtype) -> Tensor:
        if torch.compiler.is_compiling():
            return torch.ops.trackmdp.draw(self._number, name, rows, self._turn, dtype)
        drawn: Tensor = getattr(self, name)(rows)
        return drawn

    def draw(self, rows: Tensor) -> Tensor:
        """`[B]` int64 draws for the next move of the targets of a mask `[B]`."""
        return self._of("_draw", rows, torch.int64)

    def start(self, rows: Tensor) -> Tensor:
        """`[B]` places of new targets; those of the mask `[B]` are used."""
        return self._of("_start", rows, torch.int64)

    def seed(self, seed: int, stream: str) -> None:
        """Start each generator anew from the stream (`stream`, NAME) of `seed`."""
        names = (*self._names, "report") if self._missed else self._names
        self._generators = {
            name: generator(seed, stream, name, device=self._device) for name in names
        }

    def state(self) -> dict[str, Tensor]:
        """States of the generators by name, for checkpoints."""
        return {name: rng.get_state() for name, rng in self._generators.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a `state`."""
        for name, rng in self._generators.items():
            # A checkpoint read for a GPU has all its tensors there; a generator takes its state from the CPU only.
            rng.set_state(state[name].cpu())

    def __getstate__(self) -> dict[str, Any]:
        # As arrays, copied into the pickle. Of a tensor a new process gets the memory, and pickled as they are
        # generators make temporary ones, freed before the process is there ("bad value(s) in fds_to_keep").
        states = {name: rng.get_state().numpy() for name, rng in self._generators.items()}
        return self.__dict__ | {"_generators": states}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        states = {name: torch.from_numpy(each) for name, each in self._generators.items()}
        self._generators = {name: torch.Generator(self._device) for name in states}
        Targets.load_state(self, states)
        # A copy has its own generators and so needs its own number: with the old one a compiled function would draw
        # from the original's.
        self._register()

    def reports(self, rows: Tensor) -> Tensor | None:
        """`[B]` float64 uniform in [0, 1) for the targets `rows` `[B]`; None where no report is drawn."""
        return self._of("_uniform", rows, torch.float64) if self._missed else None

    def _uniform(self, rows: Tensor) -> Tensor:
        rng = self._generators["report"]
        return torch.rand(len(rows), dtype=torch.float64, generator=rng, device=self._device)

    def _start(self, rows: Tensor) -> Tensor:
        # For all rows, so that the start of a row does not depend on the others.
        rng = self._generators["start"]
        start = torch.randint(self._starts, rows.shape, generator=rng, device=self._device)
        return start if self._first is None else start + self._first

    def _draw(self, rows: Tensor) -> Tensor:
        return self.sampler.draw(len(rows), self._generators["motion"])


class RecordedTargets(Targets):
    """Targets on recorded tracks; episodes take the starts in shuffled order, each once in a round.

    Round e is shuffled by the generator (`stream`, "tracks", e).
    """

    _names = ()

    def seed(self, seed: int, stream: str) -> None:
        """See `Targets`."""
        super().seed(seed, stream)
        self._stream, self._drawn, self._orders = (seed, stream), 0, dict[int, Tensor]()

    def state(self) -> dict[str, Tensor]:
        """Number of episodes that have begun, and the generator of the reports."""
        return {"drawn": torch.tensor(self._drawn, device="cpu")} | super().state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Targets`."""
        super().load_state(state)
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
        return torch.randperm(self.sampler.starts, generator=rng, device="cpu").to(self._device)

    def _draw(self, rows: Tensor) -> Tensor:
        return torch.zeros_like(rows, dtype=torch.int64)  # moves of recorded targets are certain
