"""Advantage actor-critic over subsets of sensors, the paper's learner (Section VII; Mnih et al. 2016)."""

from __future__ import annotations

import torch
from torchrl.objectives import A2CLoss

from trackmdp.algos.on_policy import OnPolicy
from trackmdp.config.learning import A2cConfig
from trackmdp.world.model import Task


class A2C(OnPolicy):
    """One gradient step per batch: log-probability of the whole subset times its advantage."""

    def __init__(
        self,
        task: Task,
        cfg: A2cConfig,
        *,
        iterations: int,
        seed: int,  # noqa: ARG002  every learner is made alike; this one draws from torch's global generator alone
        device: torch.device,
    ) -> None:
        super().__init__(task, cfg, iterations=iterations, device=device)
        self.loss = A2CLoss(
            self.policy,
            self.critic,
            entropy_coeff=cfg.entropy.start,
            critic_coeff=cfg.critic_coef,
            loss_critic_type="l2",
        )
