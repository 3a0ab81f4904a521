"""A policy that acts at random."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase


class RandomSubset(TensorDictModuleBase):
    """Each sensor on with probability 1/2, from its own generator."""

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(self, num_sensors: int, generator: torch.Generator) -> None:
        super().__init__()
        self.num_sensors, self.generator = num_sensors, generator

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = *tensordict["last_cell"].shape, self.num_sensors
        device = self.generator.device
        drawn = torch.rand(shape, generator=self.generator, device=device) < 0.5
        return tensordict.set("action", drawn)
