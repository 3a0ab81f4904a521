"""A2C and PPO over subsets of sensors, the joint advantage of the paper.

Advantage actor-critic is the learner of the paper (Section VII; Mnih et al. 2016); proximal policy optimisation is
after Schulman et al. 2017. They have actor, critic and advantage in common.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import A2CLoss, ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE

from trackmdp.algos.common import Averages, Checkpointed, clipped_step, explained_variance, set_learning_rate
from trackmdp.config.learning import ActorCriticConfig, PpoConfig
from trackmdp.policies.nets import make_actor, make_critic
from trackmdp.seeding import generator
from trackmdp.world.model import Task

_KEPT = ("action", "action_log_prob", "advantage", "value_target")


class OnPolicy(Checkpointed):
    """Actor, critic and their optimizer, which learn from rows with a GAE advantage."""

    parts: ClassVar[tuple[str, ...]] = ("policy", "critic", "optimizer", "iteration")
    make_loss: Callable[..., LossModule]
    """Makes it of actor, critic and what all losses are told."""
    diagnostics: ClassVar = {"loss_actor": "loss_objective", "loss_critic": "loss_critic", "entropy": "entropy"}
    """What is reported, by its name in `loss`."""

    def __init__(self, task: Task, cfg: ActorCriticConfig, *, iterations: int, seed: int, device: torch.device) -> None:
        self.cfg, self._t_max = cfg, task.t_max
        self.iterations, self.iteration, self.device = iterations, 0, device
        self.policy = make_actor(task, cfg.hidden, cfg.initial_logit).to(device)
        self.critic = make_critic(task, cfg.hidden).to(device)
        self.parameters = [*self.policy.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(self.parameters, lr=cfg.learning_rate.start, eps=1e-5, fused=True)
        self.advantage = GAE(gamma=cfg.gamma, lmbda=cfg.gae_lambda, value_network=self.critic, deactivate_vmap=True)
        told = {"entropy_coeff": cfg.entropy.start, "critic_coeff": cfg.critic_coef, "loss_critic_type": "l2"}
        self.loss, self.generator = self.make_loss(self.policy, self.critic, **told), generator(seed, "minibatches")

    @property
    def actor(self) -> TensorDictModuleBase:
        """The policy itself; its mode is what is evaluated."""
        return self.policy

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Learn from one batch `[B, time]` of fresh frames."""
        data, diagnostics = self.prepare(batch)
        averages = Averages()
        for rows in self.minibatches(data):
            losses = self.loss(rows)
            total = losses["loss_objective"] + losses["loss_entropy"] + losses["loss_critic"]
            norm = clipped_step(total, self.optimizer, self.parameters, self.cfg.max_grad_norm)
            averages.add(**{name: losses[key] for name, key in self.diagnostics.items()}, grad_norm=norm)
        return diagnostics | averages.means()

    def minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """The rows of each gradient step."""
        yield data

    def prepare(self, batch: TensorDictBase | None) -> tuple[TensorDictBase, dict[str, float]]:
        """Set this iteration's schedules and return the batch as `[frames]` rows with a normalised advantage.

        The advantage is normalised at each n by itself: near the safe action returns spread wider than elsewhere. On
        forced steps that action replaces the policy's, which therefore gets no credit for them.
        """
        if batch is None:
            raise ValueError("an on-policy algorithm learns from fresh frames only")
        progress = self.iteration / self.iterations
        self.iteration += 1
        rate, entropy = self.cfg.learning_rate.at(progress), self.cfg.entropy.at(progress)
        set_learning_rate(self.optimizer, rate)
        self.loss.entropy_coeff.fill_(entropy)
        # Before the advantage, so that the critic's targets are scaled as well; evaluation never sees scaled rewards.
        batch["next", "reward"] = batch["next", "reward"] * self.cfg.reward_scale
        with torch.no_grad():
            self.advantage(batch)
        fit = explained_variance(batch["state_value"], batch["value_target"]).item()
        data = batch.select(*self.critic.in_keys, *_KEPT).reshape(-1)
        data["advantage"] = _normalised(data["advantage"], data["steps_since_detection"].unsqueeze(-1), self._t_max)
        return data, {"learning_rate": rate, "entropy_coef": entropy, "explained_variance": fit}


def _normalised(advantage: Tensor, misses: Tensor, t_max: int) -> Tensor:
    """`advantage` with mean 0 and variance 1 over the rows of each n up to `t_max`, 0 elsewhere.

    One row alone tells nothing.
    """
    normalised = torch.zeros_like(advantage)
    for n in range(t_max + 1):
        counted = misses == n
        chosen = advantage[counted]
        # The standard deviation of one number is nan.
        if len(chosen) > 1:
            normalised[counted] = (chosen - chosen.mean()) / (chosen.std() + 1e-8)
    return normalised


class A2C(OnPolicy):
    """One gradient step per batch: log-probability of the whole subset times its advantage."""

    make_loss = A2CLoss


class PPO(OnPolicy):
    """Each batch is passed over `epochs` times in `minibatches` parts, the probability ratio clipped.

    One Bernoulli per sensor; ratio and advantage belong to the whole subset.
    """

    cfg: PpoConfig
    parts: ClassVar[tuple[str, ...]] = (*OnPolicy.parts, "generator")
    diagnostics: ClassVar = OnPolicy.diagnostics | {"approx_kl": "kl_approx", "clip_fraction": "clip_fraction"}

    def make_loss(self, *nets: TensorDictModuleBase, **told: Any) -> LossModule:
        """The clipped surrogate."""
        return ClipPPOLoss(*nets, clip_epsilon=self.cfg.clip_epsilon, normalize_advantage=False, **told)

    def minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """The rows of each gradient step."""
        for _ in range(self.cfg.epochs):
            order = torch.randperm(len(data), generator=self.generator)
            yield from (data[rows] for rows in order.chunk(self.cfg.minibatches))
