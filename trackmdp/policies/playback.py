"""A recorded history as a policy."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from trackmdp.world.model import BoolArray

__all__ = ["Playback"]


class Playback(TensorDictModuleBase):
    """Re-issues the actions `[T, M]` of an episode in their order, one a call, whatever is observed.

    After the last no sensor is on, so that the safe action locates the target.
    """

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]
    actions: Tensor

    def __init__(self, actions: BoolArray, device: torch.device | str = "cpu") -> None:
        super().__init__()
        self.register_buffer("actions", torch.as_tensor(actions, dtype=torch.bool, device=device))
        self.step = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`: the same for all rows."""
        shape = (*tensordict["last_cell"].shape, self.actions.shape[1])
        over = self.step >= len(self.actions)
        action = torch.zeros_like(self.actions[0]) if over else self.actions[self.step]
        self.step += 1
        return tensordict.set("action", action.expand(shape).clone())
