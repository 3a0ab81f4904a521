"""Policies that learn nothing: fixed subsets, random subsets, and tables of chains."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

__all__ = ["AllOn", "ChainPolicy", "RandomSubset"]


class AllOn(TensorDictModuleBase):
    """Every sensor on (or, with `on=False`, none) at every step."""

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(self, num_cells: int, on: bool = True) -> None:
        super().__init__()
        self.num_cells, self.on = num_cells, on

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`."""
        cell = tensordict["last_cell"]
        action = torch.full((*cell.shape, self.num_cells), self.on, dtype=torch.bool, device=cell.device)
        return tensordict.set("action", action)


class RandomSubset(TensorDictModuleBase):
    """Each sensor on with probability 1/2, from its own generator; what benchmarks drive the environment with."""

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(self, num_cells: int, generator: torch.Generator) -> None:
        super().__init__()
        self.num_cells, self.generator = num_cells, generator
        self.register_buffer("_shifts", torch.arange(63, device=generator.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`: the bits of random 63-bit words."""
        shape, m = tensordict["last_cell"].shape, self.num_cells
        words = torch.empty(*shape, -(-m // 63), dtype=torch.int64, device=self.generator.device)
        words.random_(generator=self.generator)
        bits = (words.unsqueeze(-1) >> self._shifts) & 1
        return tensordict.set("action", bits.flatten(-2)[..., :m].bool())


class ChainPolicy(TensorDictModuleBase):
    """A policy as a table: the sensors on at n misses after locating the target in x.

    Args:
        chains: `[M, t_max+1, M]`, bool, or the probabilities of switching each sensor on.
        device: where the table lives.
        generator: draws the sensors where `chains` are probabilities.
    """

    in_keys: ClassVar = ["last_cell", "steps_since_detection"]
    out_keys: ClassVar = ["action"]

    def __init__(
        self,
        chains: npt.NDArray[np.generic],
        device: torch.device | str = "cpu",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.generator = generator
        self.register_buffer("chains", torch.as_tensor(chains, device=device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`; where the safe action is forced the last set stands in, unused."""
        n = tensordict["steps_since_detection"].clamp_max(self.chains.shape[1] - 1)
        on = self.chains[tensordict["last_cell"], n]
        if on.dtype != torch.bool:
            on = torch.rand(on.shape, generator=self.generator, device=on.device) < on
        return tensordict.set("action", on)
