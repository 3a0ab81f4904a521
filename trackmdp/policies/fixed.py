"""Modules that act while frames are collected or measured: random subsets, and a table that a learner rewrites.

`Policy` stands for a policy that is finished; a learner writes into the tables here after every update.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from trackmdp.world.model import BoolArray

__all__ = ["ChainPolicy", "RandomSubset"]


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
        # 63 bits a word: `random_` fills int64 from 0 to 2^63 - 1, so that the sign bit is never set.
        words = torch.empty(*shape, -(-m // 63), dtype=torch.int64, device=self.generator.device)
        words.random_(generator=self.generator)
        bits = (words.unsqueeze(-1) >> self._shifts) & 1
        return tensordict.set("action", bits.flatten(-2)[..., :m].bool())


class ChainPolicy(TensorDictModuleBase):
    """A table on the learner's device, rewritten in place: the sensors on at n misses after locating the target in x.

    Args:
        chains: `[M, t_max+1, M]` bool.
        device: where the table lives.
    """

    in_keys: ClassVar = ["last_cell", "steps_since_detection"]
    out_keys: ClassVar = ["action"]
    chains: Tensor

    def __init__(self, chains: BoolArray, device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.register_buffer("chains", torch.as_tensor(chains, dtype=torch.bool, device=device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`; where the safe action is forced the last set stands in, unused."""
        # chains has no slot for n = t_max + 1.
        n = tensordict["steps_since_detection"].clamp_max(self.chains.shape[1] - 1)
        return tensordict.set("action", self.chains[tensordict["last_cell"], n])
