"""Double DQN with a Q that adds up over the sensors, so that the best of 2^M subsets is a comparison per sensor.

Mnih et al. 2015, van Hasselt et al. 2016; value decomposition after Sunehag et al. 2018. One joint TD target.

Prioritised replay in plain torch: no C++ extension, any device, and a state that loads with `weights_only=True`.

Schaul et al. 2016. One cumulative sum per draw, O(capacity): as fast as a segment tree up to some 10^5 items.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictParams,
    TensorDictSequential,
)
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage
from torchrl.objectives import LossModule, SoftUpdate

from trackmdp.algos.common import (
    Averages,
    Checkpointed,
    check_type,
    clipped_step,
    set_learning_rate,
)
from trackmdp.config.learning import DqnConfig
from trackmdp.config.tree import flatten
from trackmdp.policies.few_sensors import greedy
from trackmdp.policies.forms import STATE_KEYS
from trackmdp.policies.qvalue import EpsilonFlip, joint_value, make_qvalue
from trackmdp.seeding import generator
from trackmdp.sensing.task import Task

# An item of priority 0 would never be drawn again.
_SMALLEST = 1e-8


class PrioritizedSampler(Sampler):
    """Draws item i with probability p_i^alpha / Σ p^alpha; new items get the largest priority seen so far.

    `sample` also returns `priority_weight` `[batch]`, (N · P(i))^-beta over its largest possible value.
    """

    def __init__(
        self, capacity: int, alpha: float, beta: float, device: torch.device | str = "cpu"
    ) -> None:
        self.alpha, self.beta = alpha, beta
        self._mass = torch.zeros(capacity, dtype=torch.float64, device=device)
        self._largest = torch.ones((), dtype=torch.float64, device=device)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Tensor]]:
        """`[batch]` indices and their importance weights."""
        mass = self._mass[: len(storage)]
        edges = mass.cumsum(0)
        draws = torch.rand(batch_size, dtype=torch.float64, generator=self._rng, device=mass.device)
        # Inverse of the distribution function: masses 1, 0, 3 have edges 1 1 4; with right=True a draw of exactly 1
        # falls to item 2. The clamp is for rounding at the last edge.
        index = torch.searchsorted(edges, draws * edges[-1], right=True).clamp_max(len(mass) - 1)
        # (N P(i))^-beta over its maximum, which the item of least mass has: N and the sum cancel.
        weight = (mass[index] / mass.min()) ** -self.beta
        return index, {"priority_weight": weight.float()}

    def extend(self, index: Tensor) -> None:
        """Give new items the largest priority, so that each is seen at least once."""
        self._mass[index] = self._largest**self.alpha

    def update_priority(self, index: Tensor | int, priority: Tensor | float, **_: Any) -> None:
        """Set the priorities of `index` to |priority|."""
        value = (
            torch.as_tensor(priority, dtype=torch.float64, device=self._mass.device).abs()
            + _SMALLEST
        )
        self._largest = torch.maximum(self._largest, value.max())
        self._mass[index] = value**self.alpha

    def state_dict(self) -> dict[str, Any]:
        """Tensors only."""
        return {"mass": self._mass, "largest": self._largest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._mass.copy_(state_dict["mass"])
        self._largest = state_dict["largest"].clone()

    def _empty(self) -> None:
        self._mass.zero_()
        self._largest.fill_(1.0)

    def dumps(self, path: str | Path) -> None:
        """Not offered: checkpoints hold `state_dict`."""
        raise NotImplementedError("save state_dict() instead")

    def loads(self, path: str | Path) -> None:
        """Not offered: checkpoints hold `state_dict`."""
        raise NotImplementedError("use load_state_dict() instead")


class AdditiveDQNLoss(LossModule):
    """Squared TD error of an additive Q (`AdditiveQ`).

    The target is y = R + γ^n Q'(s', a') while s' is not terminal, with a' = {j : q_j(s') > 0}, with a budget the best
    of these, chosen by the online network (per sensor, which for an additive Q is the joint maximum) and valued by the
    target network.

    Writes `td_error` `[batch]`; weighs by `priority_weight` where there is one.
    """

    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

    def __init__(self, qvalue: TensorDictModule, budget: int | None = None) -> None:
        super().__init__()
        self.budget = budget
        self.convert_to_functional(qvalue, "qvalue_network", create_target_params=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """`loss` of a batch of transitions as `n_step` makes them."""
        net, following = self.qvalue_network, tensordict["next"]
        with self.qvalue_network_params.to_module(net):
            chosen = joint_value(*self._values(tensordict), tensordict["action"], self.budget)
            with torch.no_grad():
                best = greedy(self._values(following)[1], self.budget)
        with torch.no_grad(), self.target_qvalue_network_params.to_module(net):
            future = joint_value(*self._values(following), best, self.budget)
            alive = ~following["terminated"].squeeze(-1)
            target = following["reward"].squeeze(-1) + tensordict["discount"] * future * alive
        error = target - chosen
        tensordict["td_error"] = error.detach().abs()
        weight = tensordict.get("priority_weight", torch.ones_like(error))
        return TensorDict(
            {"loss": (weight * error.square()).mean(), "q_value": chosen.detach().mean()}
        )

    def _values(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        net = self.qvalue_network
        # The network itself: by way of a TensorDict a batch of a thousand states takes a third longer.
        base, sensor = net.module(*(tensordict[key] for key in net.in_keys))
        return base, sensor


class _ZeroedStorage(LazyTensorStorage):
    """Slots that hold no transition yet are zero, so that a checkpoint is the same bytes in every process."""

    def _init(self, data: TensorDictBase) -> None:
        log = logging.getLogger("torchrl")
        level = log.level
        log.setLevel(logging.WARNING)  # it prints a line for each storage
        try:
            super()._init(data)
        finally:
            log.setLevel(level)
        self._storage.zero_()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a `state_dict`, in whose types all later transitions are stored."""
        for name, part in flatten(state_dict).items():
            real = name.endswith(("reward", "discount"))
            if isinstance(part, Tensor):
                check_type(name, part, *((torch.float32,) if real else (torch.int64, torch.bool)))
        super().load_state_dict(state_dict)


class DQN(Checkpointed):
    """Learns off policy from a replay buffer; explores by flipping sensors; the target network is evaluated."""

    parts = (
        "loss",
        "optimizer",
        "buffer",
        "generator",
        "explore",
        "iteration",
    )

    def __init__(
        self,
        task: Task,
        cfg: DqnConfig,
        *,
        iterations: int,
        seed: int,
        device: torch.device,
        targets: Sequence[int] = (),
    ) -> None:
        self.cfg, self.iterations, self.iteration, self.device = cfg, iterations, 0, device
        self._scale = cfg.reward_scale / task.reward
        qvalue = make_qvalue(task, cfg.hidden, self._scale, targets).to(device)
        self.budget = task.budget
        self.explore = EpsilonFlip(cfg.epsilon.start, qvalue.module.units, task.budget).to(device)
        self.policy = TensorDictSequential(qvalue, self.explore)
        self.loss = AdditiveDQNLoss(qvalue, task.budget)
        self.target = SoftUpdate(self.loss, tau=cfg.target_tau)
        self.slow = make_qvalue(task, cfg.hidden, self._scale, targets).to(device)
        self.parameters = list(qvalue.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, lr=cfg.learning_rate.start, fused=True)
        per = cfg.prioritized
        sampler = None  # as likely each
        if per.enabled:
            sampler = PrioritizedSampler(cfg.buffer_size, per.alpha, per.beta, device)
        self.buffer = TensorDictReplayBuffer(
            storage=_ZeroedStorage(cfg.buffer_size, device=device),
            sampler=sampler,
            batch_size=cfg.batch_size,
        )
        self.generator = generator(seed, "buffer", device=device)
        self.buffer.set_rng(self.generator)

    @property
    def actor(self) -> TensorDictModuleBase:
        """Greedy in the slowly moving target network, which averages the updates' noise out."""
        self.loss.target_qvalue_network_params.data.to_module(self.slow)
        flip = EpsilonFlip(0.0, budget=self.budget).to(self.explore.epsilon.device)
        return TensorDictSequential(self.slow, flip)

    def state_dict(self) -> dict[str, Any]:
        """See `Checkpointed`."""
        state = super().state_dict()
        # TorchRL makes it anew on the device that it was saved on, which need not be here; ours is saved by itself.
        state["buffer"]["_rng"] = None
        return state

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Store one batch `[B, time]`, then update `updates` times."""
        progress = self.iteration / self.iterations
        self.iteration += 1
        rate = self.cfg.learning_rate.at(progress)
        set_learning_rate(self.optimizer, rate)
        if batch is not None:
            batch["next", "reward"] = batch["next", "reward"] * self._scale
            self.buffer.extend(n_step(batch, self.cfg.n_step, self.cfg.gamma, self.policy.in_keys))
        averages = Averages()
        for _ in range(self.cfg.updates):
            rows = self.buffer.sample()
            losses = self.loss(rows)
            norm = clipped_step(
                losses["loss"], self.optimizer, self.parameters, self.cfg.max_grad_norm
            )
            self.target.step()
            if self.cfg.prioritized.enabled:
                self.buffer.update_priority(rows["index"], rows["td_error"])
            error = rows["td_error"].mean()
            averages.add(
                loss=losses["loss"], q_value=losses["q_value"], td_error=error, grad_norm=norm
            )
        epsilon = self.cfg.epsilon.at(progress)
        self.explore.epsilon.fill_(epsilon)
        return {"learning_rate": rate, "epsilon": epsilon} | averages.means()


def n_step(
    batch: TensorDictBase, steps: int, gamma: float, state: Sequence[str] = STATE_KEYS
) -> TensorDictBase:
    """Transitions `[B · time]` that bootstrap after up to `steps` steps.

    A sum stops at the end of an episode and at the end of the batch. `discount` is γ^k for the k steps taken, and
    ("next", state and flags) are those after the k steps. (TorchRL's MultiStep leaves the flags of the first step.)

    Args:
        batch: collected frames `[B, time]`.
        steps: n.
        gamma: discount.
        state: keys of a state that a policy reads.
    """
    reward, done = batch["next", "reward"].squeeze(-1), batch["next", "done"].squeeze(-1)
    total, taken, alive = reward.clone(), torch.ones_like(reward, dtype=torch.int64), ~done
    for k in range(1, min(steps, batch.shape[1])):
        alive[:, -k:] = False
        total[:, :-k] += gamma**k * reward[:, k:] * alive[:, :-k]
        taken += alive
        alive[:, :-k] &= ~done[:, k:]
    following = batch["next"].select(*state, "terminated")
    if steps > 1:
        following = following.gather(
            1, torch.arange(batch.shape[1], device=taken.device) + taken - 1
        )
    following["reward"] = total.unsqueeze(-1)
    rows = batch.select(*state, "action")
    rows["discount"] = gamma ** taken.to(reward.dtype)
    rows["next"] = following
    return rows.reshape(-1)
