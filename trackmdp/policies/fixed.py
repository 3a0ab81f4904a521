"""Random subsets, which drive the environment in benchmarks; `Policy` stands for a policy that is finished."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn


class RandomSubset(TensorDictModuleBase):
    """Each sensor on with probability 1/2, from its own generator; what benchmarks drive the environment with."""

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(self, num_cells: int, generator: torch.Generator) -> None:
        super().__init__()
        self.num_cells, self.generator = num_cells, generator
        self._shifts = nn.Buffer(torch.arange(63, device=generator.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`: the bits of random 63-bit words."""
        shape, m = tensordict["last_cell"].shape, self.num_cells
        # 63 bits a word: `random_` fills int64 from 0 to 2^63 - 1, so that the sign bit is never set.
        words = torch.empty(*shape, -(-m // 63), dtype=torch.int64, device=self.generator.device)
        words.random_(generator=self.generator)
        bits = (words.unsqueeze(-1) >> self._shifts) & 1
        return tensordict.set("action", bits.flatten(-2)[..., :m].bool())
