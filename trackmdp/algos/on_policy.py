"""A2C and PPO over subsets of sensors, the joint advantage of the paper.

Advantage actor-critic is the learner of the paper (Section VII; Mnih et al. 2016); proximal policy optimisation is
after Schulman et al. 2017. They have actor, critic and advantage in common.

The price of a set is known, so its gradient is exact: the expected price Σ_j c_j π_j takes the place of the price paid,
in the rewards and in the loss. The expectation of the policy gradient is the same, but an advantage has no noise from
the prices of a hundred sensors: E[-c_j a_j ∇ log π] = -c_j ∇π_j, for any actions of the others. An
actor of one's own may have other distributions; for it, prices are as paid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE

from trackmdp.algos.common import (
    Averages,
    Checkpointed,
    clipped_step,
    explained_variance,
    set_learning_rate,
)
from trackmdp.config.learning import ActorCriticConfig, PpoConfig
from trackmdp.errors import UserError
from trackmdp.policies.actor_critic import make_actor, make_critic
from trackmdp.policies.encoder import last_clock
from trackmdp.seeding import generator
from trackmdp.sensing.outcomes import Costs
from trackmdp.sensing.task import Task

_KEPT = ("action", "action_log_prob", "action_mask", "advantage", "value_target")


class OnPolicy(Checkpointed):
    """Actor, critic and their optimizer, which learn from rows with a GAE advantage."""

    parts: ClassVar[tuple[str, ...]] = ("policy", "critic", "optimizer", "iteration")
    make_loss: Callable[..., LossModule]
    """Makes the loss from actor, critic and the arguments common to all losses."""
    diagnostics: ClassVar = {
        "loss_actor": "loss_objective",
        "loss_critic": "loss_critic",
        "entropy": "entropy",
    }
    """The reported diagnostics, by their names in `loss`."""

    def __init__(
        self,
        task: Task,
        cfg: ActorCriticConfig,
        *,
        iterations: int,
        seed: int,
        device: torch.device,
        targets: Sequence[int] = (),
        actor: TensorDictModuleBase | None = None,
        critic: TensorDictModuleBase | None = None,
    ) -> None:
        self.cfg, self._t_max, self._targets = cfg, task.t_max, targets
        self.iterations, self.iteration, self.device = iterations, 0, device
        self._scale = cfg.reward_scale / task.reward
        own = actor or make_actor(task, cfg.hidden, cfg.initial_logit, targets)
        self.policy = own.to(device)
        self.critic = (critic or make_critic(task, cfg.hidden, targets)).to(device)
        self.parameters = [*self.policy.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(
            self.parameters, lr=cfg.learning_rate.start, eps=1e-5, fused=True
        )
        self.advantage = GAE(
            gamma=cfg.gamma, lmbda=cfg.gae_lambda, value_network=self.critic, deactivate_vmap=True
        )
        common = {
            "entropy_coeff": cfg.entropy.start,
            "critic_coeff": cfg.critic_coef,
            "loss_critic_type": "l2",
        }
        self.costs = Costs(task, device) if actor is None else None
        # Of our own actor the loss has the distribution alone, on the logits that the prices need as well: one pass.
        acting = self.policy if self.costs is None else self.policy[-1]
        self.loss = self.make_loss(acting, self.critic, functional=False, **common)
        self.generator = generator(seed, "minibatches")

    @property
    def actor(self) -> TensorDictModuleBase:
        """The policy itself; its mode is evaluated."""
        return self.policy

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Learn from one batch `[B, time]` of fresh frames."""
        data, diagnostics = self.prepare(batch)
        averages = Averages()
        for rows in self.minibatches(data):
            if self.costs is not None:
                self.policy.get_dist_params(rows)  # writes the logits
            losses = self.loss(rows)
            total = losses["loss_objective"] + losses["loss_entropy"] + losses["loss_critic"]
            if self.costs is not None:
                chosen = self.policy.build_dist_from_params(rows).mean
                total = total + (rows["price_weight"] * price(self.costs, rows, chosen)).mean()
            norm = clipped_step(total, self.optimizer, self.parameters, self.cfg.max_grad_norm)
            averages.add(
                **{name: losses[key] for name, key in self.diagnostics.items()}, grad_norm=norm
            )
        return diagnostics | averages.means()

    def minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """The rows of each gradient step."""
        yield data

    def prepare(self, batch: TensorDictBase | None) -> tuple[TensorDictBase, dict[str, float]]:
        """Set this iteration's schedules and return the batch as `[frames]` rows with a normalised advantage.

        The advantage is normalised at each n by itself: near the safe action returns spread wider than elsewhere. On
        forced steps that action replaces the policy's, which therefore gets no credit for them. Prices are paid on all
        other steps but the last of an episode; `price_weight` is their weight beside the advantage.

        Raises:
            UserError: an actor of one's own gives a probability of each sensor, not of the set.
        """
        if batch is None:
            raise ValueError("an on-policy algorithm learns from fresh frames only")
        if (found := batch["action_log_prob"].shape) != batch.shape:
            raise UserError(
                f"actor: action_log_prob {list(found)}, expected one number for a set, {list(batch.shape)}, as of "
                "torch.distributions.Independent(Bernoulli(logits=...), 1)"
            )
        progress = self.iteration / self.iterations
        self.iteration += 1
        rate, entropy = self.cfg.learning_rate.at(progress), self.cfg.entropy.at(progress)
        set_learning_rate(self.optimizer, rate)
        self.loss.entropy_coeff.fill_(entropy)
        clock = last_clock(batch["steps_since_detection"], self._targets).unsqueeze(-1)
        paid = (clock <= self._t_max) & ~batch["next", "terminated"]
        reward = batch["next", "reward"]
        if self.costs is not None:
            expected = self.policy.build_dist_from_params(batch).mean
            more = batch["action"].float() - expected
            reward = reward + price(self.costs, batch, more) * paid
        # Before the advantage, so that the critic's targets are scaled as well; evaluation never sees scaled rewards.
        batch["next", "reward"] = reward * self._scale
        with torch.no_grad():
            self.advantage(batch)
        fit = explained_variance(batch["state_value"], batch["value_target"]).item()
        seen = {*self.critic.in_keys, *self.policy.in_keys}
        data = batch.select(*sorted(seen), *_KEPT, strict=False).reshape(-1)
        data["advantage"], unit = _normalised(data["advantage"], clock.reshape(-1, 1), self._t_max)
        data["price_weight"] = unit * paid.reshape(-1, 1) * self._scale
        return data, {"learning_rate": rate, "entropy_coef": entropy, "explained_variance": fit}


def price(costs: Costs, rows: TensorDictBase, share: Tensor) -> Tensor:
    """`[*B, 1]` price of sensors that are on to the `share` `[*B, K]`; sensors that cannot be chosen are free."""
    if "action_mask" in rows.keys():  # noqa: SIM118 (no dict)
        share = share * rows["action_mask"]
    return (share * costs.of_each(rows["last_cell"])).sum(-1, keepdim=True)


def _normalised(advantage: Tensor, misses: Tensor, t_max: int) -> tuple[Tensor, Tensor]:
    """`advantage` with mean 0 and variance 1 over the rows of each n up to `t_max`, and its factor; 0 elsewhere.

    One row alone gives no variance.
    """
    normalised, unit = torch.zeros_like(advantage), torch.zeros_like(advantage)
    for n in range(t_max + 1):
        counted = misses == n
        chosen = advantage[counted]
        # The standard deviation of one number is nan.
        if len(chosen) > 1:
            unit[counted] = 1.0 / (chosen.std() + 1e-8)
            normalised[counted] = (chosen - chosen.mean()) * unit[counted]
    return normalised, unit


class A2C(OnPolicy):
    """One gradient step per batch: log-probability of the whole subset times its advantage."""

    make_loss = A2CLoss


class PPO(OnPolicy):
    """Each batch is passed over `epochs` times in `minibatches` parts, the probability ratio clipped.

    One Bernoulli per sensor; ratio and advantage belong to the whole subset.
    """

    cfg: PpoConfig
    parts = (*OnPolicy.parts, "generator")
    diagnostics: ClassVar = OnPolicy.diagnostics | {
        "approx_kl": "kl_approx",
        "clip_fraction": "clip_fraction",
    }

    def make_loss(self, *nets: TensorDictModuleBase, **common: Any) -> LossModule:
        """The clipped surrogate."""
        return ClipPPOLoss(
            *nets, clip_epsilon=self.cfg.clip_epsilon, normalize_advantage=False, **common
        )

    def minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """The rows of each gradient step."""
        for _ in range(self.cfg.epochs):
            order = torch.randperm(len(data), generator=self.generator)
            yield from (data[rows] for rows in order.chunk(self.cfg.minibatches))
