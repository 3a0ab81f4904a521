"""Proximal policy optimisation over subsets of sensors (Schulman et al. 2017), the joint advantage of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torchrl.objectives import ClipPPOLoss

from trackmdp.algos.on_policy import OnPolicy
from trackmdp.config.learning import PpoConfig
from trackmdp.seeding import generator
from trackmdp.world.model import Task


class PPO(OnPolicy):
    """Each batch is passed over `epochs` times in `minibatches` parts, the probability ratio clipped.

    One Bernoulli per sensor; ratio and advantage belong to the whole subset.
    """

    cfg: PpoConfig
    parts: ClassVar[tuple[str, ...]] = (*OnPolicy.parts, "generator")
    diagnostics: ClassVar = OnPolicy.diagnostics | {"approx_kl": "kl_approx", "clip_fraction": "clip_fraction"}

    def __init__(self, task: Task, cfg: PpoConfig, *, iterations: int, seed: int, device: torch.device) -> None:
        super().__init__(task, cfg, iterations=iterations, device=device)
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

    def minibatches(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """The rows of each gradient step."""
        for _ in range(self.cfg.epochs):
            order = torch.randperm(len(data), generator=self.generator)
            yield from (data[rows] for rows in order.chunk(self.cfg.minibatches))
