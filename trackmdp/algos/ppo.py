"""Proximal policy optimisation over subsets of sensors (Schulman et al. 2017), the joint advantage of the paper."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.objectives import ClipPPOLoss

from trackmdp.algos.common import Averages, clipped_step
from trackmdp.algos.on_policy import OnPolicy
from trackmdp.config.learning import PpoConfig
from trackmdp.seeding import generator
from trackmdp.world.model import Task


class PPO(OnPolicy):
    """Each batch is passed over `epochs` times in `minibatches` parts, the probability ratio clipped.

    One Bernoulli per sensor; ratio and advantage belong to the whole subset.
    """

    def __init__(self, task: Task, cfg: PpoConfig, *, iterations: int, seed: int, device: torch.device) -> None:
        super().__init__(task, cfg, iterations=iterations, device=device)
        self.cfg = cfg
        self.generator = generator(seed, "minibatches")
        self.loss = ClipPPOLoss(
            self.policy,
            self.critic,
            clip_epsilon=cfg.clip_epsilon,
            entropy_coeff=cfg.entropy.start,
            critic_coeff=cfg.critic_coef,
            loss_critic_type="l2",
            normalize_advantage=False,
        )

    def step(self, batch: TensorDictBase | None) -> dict[str, float]:
        """Learn from one batch `[B, time]` of fresh frames."""
        data, diagnostics = self.prepare(batch)
        averages = Averages()
        for _ in range(self.cfg.epochs):
            order = torch.randperm(len(data), generator=self.generator)
            for rows in order.chunk(self.cfg.minibatches):
                losses = self.loss(data[rows])
                total = losses["loss_objective"] + losses["loss_entropy"] + losses["loss_critic"]
                norm = clipped_step(total, self.optimizer, self.parameters, self.cfg.max_grad_norm)
                averages.add(
                    loss_actor=losses["loss_objective"],
                    loss_critic=losses["loss_critic"],
                    entropy=losses["entropy"],
                    approx_kl=losses["kl_approx"],
                    clip_fraction=losses["clip_fraction"],
                    grad_norm=norm,
                )
        return diagnostics | averages.means()

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimizer, iteration and the generator of the minibatches."""
        return super().state_dict() | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        super().load_state_dict(state)
        self.generator.set_state(state["generator"].cpu())
