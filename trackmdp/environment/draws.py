"""Random draws from named generators, with the same numbers under `torch.compile` as without it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor, library

from trackmdp.seeding import generator

_DRAWS: WeakValueDictionary[int, Draw] = WeakValueDictionary()
"""Number -> draw: a graph can hold a number, but no generator."""

_numbers = itertools.count()


class Draw:
    """One draw for a batch of rows, from a generator that its owner keeps.

    TorchDynamo cannot put a call with a `torch.Generator` into a graph (torch 2.13: "Failed to convert args/kwargs to
    proxy", gb0055), and breaks the graph in two around it. There the draw is an operator of its own, which the compiler
    does not trace.

    Args:
        draw: returns `[B]` draws for the mask `[B]` of the rows that use theirs.
        dtype: dtype of the draws.
        device: device of the draws.
    """

    def __init__(
        self, draw: Callable[[Tensor], Tensor], dtype: torch.dtype, device: torch.device
    ) -> None:
        self._draw, self._dtype = draw, dtype
        self._turn = torch.zeros((), device=device)
        self._register()

    def _register(self) -> None:
        self._number = next(_numbers)
        _DRAWS[self._number] = self

    def __call__(self, rows: Tensor) -> Tensor:
        """`[B]` draws; the rows of the mask `rows` `[B]` use theirs."""
        if torch.compiler.is_compiling():
            return torch.ops.trackmdp.draw(self._number, rows, self._turn, self._dtype)
        return self._draw(rows)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copy has its own generator and so needs its own number: with the old one a compiled function would draw from
        # the original's generator.
        self.__dict__.update(state)
        self._register()


class Streams:
    """Named random generators of a subclass, with their state for checkpoints.

    Args:
        device: device of the generators.
        names: names of the generators.
    """

    def __init__(self, device: torch.device, *names: str) -> None:
        self.device, self._names = device, names
        self.generators: dict[str, torch.Generator] = {}

    def seed(self, seed: int, stream: str) -> None:
        """Start each generator anew from the stream (`stream`, NAME) of `seed`."""
        self.generators = {
            name: generator(seed, stream, name, device=self.device) for name in self._names
        }

    def state(self) -> dict[str, Tensor]:
        """States of the generators by name."""
        return {name: rng.get_state() for name, rng in self.generators.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a `state`."""
        for name, rng in self.generators.items():
            # A checkpoint read for a GPU has all its tensors there; a generator takes its state from the CPU only.
            rng.set_state(state[name].cpu())

    def __getstate__(self) -> dict[str, Any]:
        # As arrays, copied into the pickle. Of a tensor a new process gets the memory, and pickled as they are
        # generators make temporary ones, freed before the process is there ("bad value(s) in fds_to_keep").
        states = {name: state.numpy() for name, state in self.state().items()}
        return self.__dict__ | {"generators": states}

    def __setstate__(self, state: dict[str, Any]) -> None:
        states = {name: torch.from_numpy(each) for name, each in state["generators"].items()}
        self.__dict__.update(state)
        self.generators = {name: torch.Generator(self.device) for name in states}
        self.load_state(states)


class UniformDraws(Streams):
    """Uniform draws in [0, 1) of one generator.

    Args:
        device: device of the draws.
        name: name of the generator; None: nothing is ever drawn.
    """

    def __init__(self, device: torch.device, name: str | None) -> None:
        super().__init__(device, *(() if name is None else (name,)))
        self._draw = Draw(self._uniform, torch.float64, device)

    def __call__(self, rows: Tensor) -> Tensor | None:
        """`[B]` float64 draws of the targets `rows` `[B]`; None without a generator."""
        return self._draw(rows) if self._names else None

    def _uniform(self, rows: Tensor) -> Tensor:
        rng = self.generators[self._names[0]]
        return torch.rand(len(rows), dtype=torch.float64, generator=rng, device=self.device)


# `turn` is never written to. Because it might be, the compiler does not merge, drop or swap two draws.
@library.custom_op("trackmdp::draw", mutates_args={"turn"})
def _draw(number: int, rows: Tensor, turn: Tensor, dtype: torch.dtype) -> Tensor:  # noqa: ARG001
    # As without the compiler: nothing is drawn for no row.
    if not bool(rows.any()):
        return torch.zeros(rows.shape, dtype=dtype, device=rows.device)
    return _DRAWS[number]._draw(rows)


@_draw.register_fake
def _(number: int, rows: Tensor, turn: Tensor, dtype: torch.dtype) -> Tensor:  # noqa: ARG001
    return torch.empty(rows.shape, dtype=dtype, device=rows.device)
