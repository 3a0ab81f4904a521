"""One A2C update against the formula."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import algorithm, collect, small_world
from trackmdp.algos.on_policy import price
from trackmdp.policies.actor_critic import SubsetDistribution


def test_one_step_descends_the_printed_loss() -> None:
    """-mean(A·log π(a)) - 0.03·mean entropy + 0.5·mean (V - target)² + mean expected price, of which the norm is."""
    world = small_world()
    torch.manual_seed(0)
    entropy = "algo.entropy={start: 0.03, end: 0.03, begin: 0, until: 1}"
    learner = algorithm("a2c", world, entropy, "algo.critic_coef=0.5")
    batch = collect(world, learner.policy, 32, 8)
    with torch.no_grad():
        learner.policy.module[0].module.network.head.weight.normal_(
            std=0.1
        )  # off the policy that collected
    data, _ = learner.prepare(batch.clone())
    learner.iteration -= 1
    subsets = SubsetDistribution(learner.policy.module[0](data.clone())["logits"])
    advantage, target = data["advantage"].squeeze(-1), data["value_target"].squeeze(-1)
    actor = -(advantage * subsets.log_prob(data["action"])).mean()
    critic = (learner.critic(data.clone())["state_value"].squeeze(-1) - target).square().mean()
    spent = price(learner.costs, data, subsets.base_dist.probs)
    exact = (data["price_weight"] * spent).mean()
    total = actor - 0.03 * subsets.entropy().mean() + 0.5 * critic + exact
    gradient = torch.autograd.grad(total, learner.parameters)
    norm = torch.stack([part.norm() for part in gradient]).norm()
    before = [p.detach().clone() for p in learner.parameters]
    diagnostics = learner.step(batch)
    assert diagnostics["loss_actor"] == pytest.approx(actor.item(), abs=1e-5)
    assert diagnostics["loss_critic"] == pytest.approx(0.5 * critic.item(), rel=1e-4)
    assert diagnostics["entropy"] == pytest.approx(subsets.entropy().mean().item(), rel=1e-4)
    assert diagnostics["grad_norm"] == pytest.approx(norm.item(), rel=1e-3)
    moved = [p.detach() - q for p, q in zip(learner.parameters, before, strict=True)]
    step = sum((move * part).sum().item() for move, part in zip(moved, gradient, strict=True))
    assert step < 0


def test_it_needs_fresh_frames() -> None:
    with pytest.raises(ValueError, match="fresh frames"):
        algorithm("a2c", small_world()).step(None)
