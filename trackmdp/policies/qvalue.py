"""Additive Q over sensors, and the subsets it chooses."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from trackmdp.policies.actor_critic import STATE_KEYS
from trackmdp.policies.encoder import StateEncoder
from trackmdp.world.model import Task

__all__ = ["AdditiveQ", "EpsilonFlip", "make_qvalue"]

_LARGEST = 6.0  # e^6 sensor costs: far above any gain worth telling apart


class AdditiveQ(nn.Module):
    """Q(s, a) = base(s) + Σ_j a_j q_j(s) with q_j = c_j (e^{u_j} - 1): what detecting with j is worth, less its price.

    The best subset is {j : q_j > 0}. The exponential keeps the many sensors that never detect anything at -c_j exactly
    where a linear q_j would scatter around it, within a threshold of a few hundredths of the gains.
    """

    def __init__(self, task: Task, hidden: int, scale: float) -> None:
        super().__init__()
        self.t_max = task.t_max
        self.encoder = StateEncoder(task, hidden)
        self.base = nn.Linear(hidden, 1)
        self.gain = nn.Linear(hidden, task.num_cells)
        for head in (self.base, self.gain):
            nn.init.orthogonal_(head.weight, gain=0.01)
            nn.init.zeros_(head.bias)
        cost = torch.as_tensor(task.cost, dtype=torch.float32) * scale
        self.register_buffer("unit", cost.clamp_min(0.01 * scale * max(task.reward, 1e-6)))
        self.register_buffer("cost", cost)

    def forward(self, last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor) -> tuple[Tensor, Tensor]:
        """`base` `[..., 1]` and `sensor_value` `[..., M]`, the latter 0 where the safe action is forced."""
        features = self.encoder(last_cell, steps_since_detection, action_history)
        gain = self.unit * torch.exp(self.gain(features).clamp_max(_LARGEST))
        free = (steps_since_detection <= self.t_max).unsqueeze(-1)
        return self.base(features), (gain - self.cost) * free


class EpsilonFlip(TensorDictModuleBase):
    """The greedy subset {j : q_j > 0}; while exploring, each sensor is flipped with probability epsilon."""

    in_keys = ["sensor_value"]
    out_keys = ["action"]

    def __init__(self, epsilon: float) -> None:
        super().__init__()
        self.register_buffer("epsilon", torch.tensor(epsilon))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`."""
        greedy = tensordict["sensor_value"] > 0
        if exploration_type() is ExplorationType.RANDOM:
            greedy = greedy ^ (torch.rand(greedy.shape, device=greedy.device) < self.epsilon)
        return tensordict.set("action", greedy)


def make_qvalue(task: Task, hidden: int, scale: float) -> TensorDictModule:
    """State -> `base`, `sensor_value`."""
    return TensorDictModule(AdditiveQ(task, hidden, scale), in_keys=STATE_KEYS, out_keys=["base", "sensor_value"])
