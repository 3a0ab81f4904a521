"""Additive Q over sensors, and the subsets it chooses."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from trackmdp.policies.encoder import StateEncoder
from trackmdp.policies.unroll import state_keys
from trackmdp.world.model import Task
from trackmdp.world.windows import Window

_ALL_ON = 0.5  # sensors start a little above zero: what can be left out is learned, not what must be found


class AdditiveQ(nn.Module):
    """Q(s, a) = V(s) + Σ_j (a_j - 1[q_j(s) > 0]) q_j(s): a dueling network over sensors.

    V(s) is the value of the best subset {j : q_j > 0}, and only sensors that differ from it contribute, so that the
    targets' noise reaches q_j through the few sensors flipped for exploration alone (after Wang et al. 2016).
    q_j counts in units of the sensor's price.
    """

    def __init__(self, task: Task, hidden: int, scale: float) -> None:
        super().__init__()
        self.t_max = task.t_max
        self.encoder = StateEncoder(task, hidden, scale=1.0, history_scale=0.03)
        self.base, self.sensor = nn.Linear(hidden, 1), nn.Linear(hidden, task.num_sensors)
        for head, start in ((self.base, 0.0), (self.sensor, _ALL_ON)):
            nn.init.orthogonal_(head.weight, gain=0.01)
            nn.init.constant_(head.bias, start)
        price = torch.as_tensor(task.cost, dtype=torch.float32).clamp_min(0.01 * task.reward)
        self.window = Window.of(task) if task.window is not None else None
        # What lies outside the grid, cell M, has no price: there q_j is 0, and the sensor off.
        unit = price if self.window is None else nn.functional.pad(price, (0, 1))
        self.unit = nn.Buffer(scale * unit)

    def forward(
        self, last_cell: Tensor, steps_since_detection: Tensor, action_history: Tensor, *key: Tensor
    ) -> tuple[Tensor, Tensor]:
        """V `[..., 1]` and q `[..., K]`, the latter 0 where the safe action is forced and outside the grid."""
        features = self.encoder(last_cell, steps_since_detection, action_history, *key)
        free = (steps_since_detection <= self.t_max).unsqueeze(-1)
        unit = self.unit if self.window is None else self.unit[self.window.around(last_cell)]
        return self.base(features), unit * self.sensor(features) * free


def joint_value(values: TensorDictBase, action: Tensor) -> Tensor:
    """`[...]` Q(s, a) of `action` `[..., K]` from the `base` and `sensor_value` of a network."""
    sensor = values["sensor_value"]
    flipped = action.to(sensor.dtype) - (sensor > 0).to(sensor.dtype)
    return values["base"].squeeze(-1) + (sensor * flipped).sum(-1)


class EpsilonFlip(TensorDictModuleBase):
    """The greedy subset {j : q_j > 0}; while exploring, each sensor is flipped with probability epsilon.

    Sensors without a value stay off: those outside the grid, and all where the safe action is forced.

    Args:
        epsilon: that probability.
    """

    in_keys: ClassVar = ["sensor_value"]
    out_keys: ClassVar = ["action"]

    def __init__(self, epsilon: float) -> None:
        super().__init__()
        self.epsilon = nn.Buffer(torch.tensor(epsilon))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`."""
        value = tensordict["sensor_value"]
        greedy = value > 0
        if exploration_type() is ExplorationType.RANDOM:
            greedy = greedy ^ (torch.rand(value.shape, device=value.device) < self.epsilon) & (value != 0)
        return tensordict.set("action", greedy)


def make_qvalue(task: Task, hidden: int, scale: float) -> TensorDictModule:
    """State -> `base` `[B, 1]`, `sensor_value` `[B, K]`, for rewards multiplied by `scale`."""
    return TensorDictModule(AdditiveQ(task, hidden, scale), in_keys=state_keys(task), out_keys=["base", "sensor_value"])
