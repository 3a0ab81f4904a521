"""The actor, one Bernoulli per sensor, and the critic of a state."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch import distributions as dist
from torchrl.modules import ProbabilisticActor, ValueOperator

from trackmdp.policies.encoder import RelativeBias, StateNetwork, of_kinds
from trackmdp.policies.few_sensors import FewSensors
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
