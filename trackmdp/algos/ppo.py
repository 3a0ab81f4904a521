"""Proximal policy optimisation over subsets of sensors (Schulman et al. 2017), the joint advantage of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import ClipPPOLoss, LossModule

from trackmdp.algos.on_policy import OnPolicy
from trackmdp.config.learning import PpoConfig


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
