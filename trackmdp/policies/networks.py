"""Networks over states: the actor, one Bernoulli per sensor, the critic, and an additive Q with its exploration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch import distributions as dist
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import ProbabilisticActor, ValueOperator

from trackmdp.policies.encoder import RelativeBias, StateEncoder, StateNetwork, last_clock, of_kinds
from trackmdp.policies.few_sensors import FewSensors, greedy
from trackmdp.policies.forms import state_keys
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

# A logit with a sigmoid of 0 in float32: no draw from [0, 1) is below it, and log-probability and entropy are 0.
_NEVER = -200.0


class SubsetDistribution(dist.Independent):  # type: ignore[type-arg]
    """Independent sensors, each on with probability sigmoid(logit); samples are `[..., K]` bool."""

    def __init__(self, logits: Tensor) -> None:
        super().__init__(dist.Bernoulli(logits=logits, validate_args=False), 1, validate_args=False)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """A subset; compares uniform draws, which is three times as fast as torch.bernoulli."""
        shape = self._extended_shape(torch.Size(sample_shape))
        probability = torch.sigmoid(self.base_dist.logits.detach()).expand(shape)
        return torch.rand(shape, device=probability.device) < probability

    def log_prob(self, value: Tensor) -> Tensor:
        """`[...]` log-probability of the subset `value` `[..., K]`: Σ_j log σ(±z_j)."""
        logits = self.base_dist.logits
        return nn.functional.logsigmoid(torch.where(value, logits, -logits)).sum(-1)

    def entropy(self) -> Tensor:
        """`[...]` Σ_j [softplus(z_j) - z_j σ(z_j)]."""
        logits = self.base_dist.logits
        return (nn.functional.softplus(logits) - logits * torch.sigmoid(logits)).sum(-1)

    @property
    def mode(self) -> Tensor:
        """The most likely subset: sensors with a positive logit."""
        return self.base_dist.logits > 0

    deterministic_sample = mode


def make_actor(
    task: Task, hidden: int, initial_logit: float, targets: Sequence[int] = ()
) -> ProbabilisticActor:
    """State -> `logits` `[B, K]` -> `action` `[B, K]` bool, with `action_log_prob` `[B]`.

    K = M, or with `grid.window` the sensors around `last_cell`; those outside the grid are never on. With a budget no
    more are on than it allows. `targets` are the kinds of several targets (`OverTargets`).
    """
    head = nn.Linear(hidden, task.num_sensors)
    nn.init.orthogonal_(head.weight, gain=0.01)
    nn.init.constant_(head.bias, initial_logit)
    shared = of_kinds(partial(RelativeBias, task), targets)
    network = _Logits(StateNetwork(task, hidden, head, targets), shared, Window.of(task))
    few = task.budget is not None and task.budget < task.num_sensors
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=state_keys(task, targets), out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=FewSensors if few else SubsetDistribution,
        distribution_kwargs={"budget": task.budget} if few else {},
        return_log_prob=True,
    )


class _Logits(nn.Module):
    """A network's logits on top of the logits that all cells share."""

    def __init__(self, network: StateNetwork, shared: nn.Module, window: Window) -> None:
        super().__init__()
        self.network, self.shared, self.window = network, shared, window

    def forward(self, *state: Tensor) -> Tensor:
        last_cell, n, _, *key = state
        logits = self.network(*state) + self.shared(last_cell, n, *key)
        if not self.window.is_local:
            return logits
        inside = self.window.inside(last_cell.reshape(-1)).view(logits.shape)
        return logits.masked_fill(~inside, _NEVER)


def make_critic(task: Task, hidden: int, targets: Sequence[int] = ()) -> ValueOperator:
    """State -> `state_value` `[B, 1]`; `targets` as of `make_actor`."""
    head = nn.Linear(hidden, 1)
    nn.init.orthogonal_(head.weight)
    nn.init.zeros_(head.bias)
    network = StateNetwork(task, hidden, head, targets)
    return ValueOperator(network, in_keys=state_keys(task, targets))


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
