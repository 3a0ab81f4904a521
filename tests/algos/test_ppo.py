"""One PPO update against the formula."""

from __future__ import annotations

import itertools

import pytest
import torch

from tests.helpers import algorithm, collect, small_world
from trackmdp.policies.actor_critic import SubsetDistribution

ONCE = ("algo.epochs=1", "algo.minibatches=1", "algo.clip_epsilon=0.1")


def test_the_clipped_objective() -> None:
    """-mean min(ρA, clip(ρ, 0.9, 1.1)A), one ratio ρ per subset."""
    world = small_world()
    torch.manual_seed(0)
    learner = algorithm("ppo", world, *ONCE)
    batch = collect(world, learner.policy, 32, 8)
    with torch.no_grad():
        learner.policy.module[0].module.network.head.weight.normal_(
            std=0.3
        )  # off the policy that collected
    data, _ = learner.prepare(batch.clone())
    learner.iteration -= 1
    with torch.no_grad():
        subsets = SubsetDistribution(learner.policy.module[0](data.clone())["logits"])
        ratio = (subsets.log_prob(data["action"]) - data["action_log_prob"]).exp()
    advantage = data["advantage"].squeeze(-1)
    objective = -torch.minimum(ratio * advantage, ratio.clamp(0.9, 1.1) * advantage).mean()
    outside = ((ratio < 0.9) | (ratio > 1.1)).float().mean()
    assert 0.1 < outside < 0.9
    diagnostics = learner.step(batch)
    assert diagnostics["loss_actor"] == pytest.approx(objective.item(), abs=1e-5)
    assert diagnostics["clip_fraction"] == pytest.approx(outside.item(), abs=1e-5)
    assert diagnostics["approx_kl"] == pytest.approx(-ratio.log().mean().item(), abs=1e-5)


def test_the_first_pass_over_fresh_frames_has_ratio_one() -> None:
    world = small_world()
    torch.manual_seed(0)
    learner = algorithm("ppo", world, *ONCE)
    diagnostics = learner.step(collect(world, learner.policy, 32, 8))
    assert diagnostics["clip_fraction"] == 0.0
    assert diagnostics["approx_kl"] == pytest.approx(0.0, abs=1e-6)


def test_every_frame_is_used_once_per_epoch() -> None:
    world = small_world()
    learner = algorithm("ppo", world, "algo.epochs=3", "algo.minibatches=4")
    batch, seen = collect(world, learner.policy, 16, 4), []
    stock = learner.loss.forward

    def recorded(rows):  # type: ignore[no-untyped-def]
        seen.append(rows["advantage"].squeeze(-1).tolist())
        return stock(rows)

    learner.loss.forward = recorded
    data, _ = learner.prepare(batch.clone())
    learner.step(batch)
    assert [len(rows) for rows in seen] == [16] * 12
    epochs = [sorted(itertools.chain(*seen[4 * k : 4 * k + 4])) for k in range(3)]
    torch.testing.assert_close(
        torch.tensor(epochs), data["advantage"].flatten().sort().values.expand(3, 64)
    )
    assert seen[0] != seen[4] != seen[8]
