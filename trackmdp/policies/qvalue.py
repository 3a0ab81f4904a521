"""An additive Q over sensors, and its exploration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from trackmdp.policies.encoder import RelativeBias, StateEncoder, last_clock, of_kinds
from trackmdp.policies.few_sensors import greedy
from trackmdp.policies.forms import state_keys
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

# Sensors start a little above zero: the needless ones are learned, not the needed ones.
_ALL_ON = 0.5


class AdditiveQ(nn.Module):
    """Q(s, a) = V(s) + Σ_j (a_j - 1[q_j(s) > 0]) q_j(s): a dueling network over sensors.

    V(s) is the value of the best subset {j : q_j > 0}, and only sensors that differ from it contribute, so that the
    targets' noise reaches q_j through the few sensors flipped for exploration alone (after Wang et al. 2016).
    q_j counts in units of the sensor's price.
    """

    def __init__(self, task: Task, hidden: int, scale: float, targets: Sequence[int] = ()) -> None:
        super().__init__()
        self.t_max, self.targets = task.t_max, targets
        encoder = partial(StateEncoder, task, hidden, scale=1.0, history_scale=0.03)
        self.encoder = of_kinds(encoder, targets)
        self.base, self.sensor = nn.Linear(hidden, 1), nn.Linear(hidden, task.num_sensors)
        self.shared = of_kinds(partial(RelativeBias, task), targets)
        for head, start in ((self.base, 0.0), (self.sensor, _ALL_ON)):
            nn.init.orthogonal_(head.weight, gain=0.01)
            nn.init.constant_(head.bias, start)
        price = torch.as_tensor(task.paid, dtype=torch.float32).clamp_min(0.01 * task.reward)
        self.window = Window.of(task)
        # Cell M, outside the grid, has no price: there q_j is 0, and the sensor off.
        unit = nn.functional.pad(price, (0, 1)) if self.window.is_local else price
        self.unit = nn.Buffer(scale * unit)

    def forward(self, *state: Tensor) -> tuple[Tensor, Tensor]:
        """V `[..., 1]` and q `[..., K]`, the latter 0 where the safe action is forced and outside the grid."""
        last_cell, n, _, *key = state
        features = self.encoder(*state)
        free = (last_clock(n, self.targets) <= self.t_max).unsqueeze(-1)
        unit = self.units(last_cell)
        worth = self.sensor(features) + self.shared(last_cell, n, *key)
        return self.base(features), unit * worth * free

    def units(self, last_cell: Tensor) -> Tensor:
        """Prices `[K]`, or in a window `[..., K]`, of the sensors that can be chosen, scaled as rewards are."""
        return self.unit[self.window.around(last_cell)] if self.window.is_local else self.unit


def joint_value(base: Tensor, sensor: Tensor, action: Tensor, budget: int | None = None) -> Tensor:
    """`[...]` Q(s, a) of `action` `[..., K]` from a network's `base` `[..., 1]` and `sensor_value` `[..., K]`."""
    flipped = action.to(sensor.dtype) - greedy(sensor, budget).to(sensor.dtype)
    return base.squeeze(-1) + (sensor * flipped).sum(-1)


class EpsilonFlip(TensorDictModuleBase):
    """The greedy subset {j : q_j > 0}; while exploring, sensor j is flipped with probability ε / max(1, |q_j| / c_j).

    A flip costs |q_j|, so that exploring costs at most ε c_j for each sensor. With ε for all, a sensor of use is left
    out as often as a useless one is on; these misses are dear, and their noise hides the prices of the others.
    Sensors without a value stay off: those outside the grid, and all where the safe action is forced.

    Args:
        epsilon: ε.
        units: gives the c_j at `last_cell`, in the units of the values; None for a constant probability.
        budget: sensors that may be on; of more those that were flipped stay, and then the best.
    """

    in_keys: ClassVar = ["sensor_value", "last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(
        self,
        epsilon: float,
        units: Callable[[Tensor], Tensor] | None = None,
        budget: int | None = None,
    ) -> None:
        super().__init__()
        self.epsilon, self._units = nn.Buffer(torch.tensor(epsilon)), units
        self._budget = budget

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`."""
        value = tensordict["sensor_value"]
        chosen = greedy(value, self._budget)
        if exploration_type() is ExplorationType.RANDOM:
            chance = self.epsilon * (value != 0)
            if self._units is not None:
                # Outside the grid unit and value are 0, and so is the chance.
                unit = self._units(tensordict["last_cell"])
                chance = chance * unit / torch.maximum(unit, value.abs()).clamp_min(1e-30)
            flipped = torch.rand(value.shape, device=value.device) < chance
            chosen = chosen ^ flipped
            if self._budget is not None:
                # Ranks in (0, 2]: flipped ones above 1, the others by their value.
                rank = (value - value.amin(-1, keepdim=True)).tanh() + flipped + 1e-6
                chosen = greedy(rank * chosen, self._budget)
        return tensordict.set("action", chosen)


def make_qvalue(
    task: Task, hidden: int, scale: float, targets: Sequence[int] = ()
) -> TensorDictModule:
    """State -> `base` `[B, 1]`, `sensor_value` `[B, K]`, for rewards multiplied by `scale`; see `make_actor`."""
    network = AdditiveQ(task, hidden, scale, targets)
    keys = state_keys(task, targets)
    return TensorDictModule(network, in_keys=keys, out_keys=["base", "sensor_value"])
