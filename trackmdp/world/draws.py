"""Random draws that `torch.compile` takes into its graph, with the same numbers as without it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any
from weakref import WeakValueDictionary

import torch
from torch import Tensor, library

from trackmdp.seeding import generator

_DRAWS: WeakValueDictionary[int, Draw] = WeakValueDictionary()
"""Number -> what draws: a graph can hold a number, but no generator."""

_numbers = itertools.count()


class Draw:
    """One draw for a batch of rows from a generator that its owner keeps.

    TorchDynamo cannot put a call with a `torch.Generator` into a graph (torch 2.13: "Failed to convert args/kwargs to
    proxy", gb0055), and breaks the graph in two around it. There the draw is an operator of its own, which the compiler
    does not look into.

    Args:
        draw: gives `[B]` draws for the mask `[B]` of the rows that use theirs.
        dtype: of the draws.
        device: where they live.
    """

    def __init__(self, draw: Callable[[Tensor], Tensor], dtype: torch.dtype, device: torch.device) -> None:
        self._draw, self._dtype = draw, dtype
        self._turn = torch.zeros((), device=device)
        self._enter()

    def _enter(self) -> None:
        self._number = next(_numbers)
        _DRAWS[self._number] = self

    def __call__(self, rows: Tensor) -> Tensor:
        """`[B]` draws, of which the rows of the mask `rows` `[B]` use theirs."""
        if torch.compiler.is_compiling():
            return torch.ops.trackmdp.draw(self._number, rows, self._turn, self._dtype)
        return self._draw(rows)

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A copy has a generator of its own, and so needs a number of its own: by the old one a compiled function would
        # draw from the original's.
        self.__dict__.update(state)
        self._enter()


class Streams:
    """Random generators that draw for whoever inherits from this.

    Args:
        device: where they draw.
        names: of the generators.
    """

    def __init__(self, device: torch.device, *names: str) -> None:
        self.device, self._called = device, names
        self.generators: dict[str, torch.Generator] = {}

    def seed(self, seed: int, stream: str) -> None:
        """Begin the draws of the generators called (`stream`, NAME)."""
        self.generators = {name: generator(seed, stream, name, device=self.device) for name in self._called}

    def state(self) -> dict[str, Tensor]:
        """State of the generators, for a checkpoint."""
        return {name: rng.get_state() for name, rng in self.generators.items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken."""
        for name, rng in self.generators.items():
            # A checkpoint read for a GPU has all its tensors there; a generator's state is on the CPU at all times.
            rng.set_state(state[name].cpu())


# `turn` is never written to. That it might be keeps the compiler from merging, dropping or swapping two draws.
@library.custom_op("trackmdp::draw", mutates_args={"turn"})
def _draw(number: int, rows: Tensor, turn: Tensor, dtype: torch.dtype) -> Tensor:  # noqa: ARG001
    # As without the compiler, where the caller looks first: nothing is drawn for no row.
    return _DRAWS[number]._draw(rows) if bool(rows.any()) else torch.zeros(rows.shape, dtype=dtype, device=rows.device)


@_draw.register_fake
def _(number: int, rows: Tensor, turn: Tensor, dtype: torch.dtype) -> Tensor:  # noqa: ARG001
    return torch.empty(rows.shape, dtype=dtype, device=rows.device)
