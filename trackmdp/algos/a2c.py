"""Advantage actor-critic over subsets of sensors, the paper's learner (Section VII; Mnih et al. 2016)."""

from __future__ import annotations

from torchrl.objectives import A2CLoss

from trackmdp.algos.on_policy import OnPolicy


class A2C(OnPolicy):
    """One gradient step per batch: log-probability of the whole subset times its advantage."""

    make_loss = A2CLoss
