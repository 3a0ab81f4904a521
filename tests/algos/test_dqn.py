"""The additive double-DQN loss against hand-made targets, and what happens around it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from tests.helpers import algorithm, collect, small_world
from trackmdp.algos.dqn import AdditiveDQNLoss, n_step
from trackmdp.policies.qvalue import joint_value, make_qvalue

WORLD = small_world(t_max=1)
KEYS = ("last_cell", "steps_since_detection", "action_history")


def transitions(steps: int = 2):  # type: ignore[no-untyped-def]
    policy = algorithm("dqn", WORLD, "algo.epsilon.start=0.5").policy
    return n_step(collect(WORLD, policy, 20, 10, max_steps=4), steps, 0.7)


def random_network():  # type: ignore[no-untyped-def]
    module = make_qvalue(WORLD.task, 16, 1.0)
    with torch.no_grad():
        module.module.sensor.weight.normal_()
        module.module.base.weight.normal_()
    return module


def test_the_target_is_chosen_online_and_valued_by_the_target_network() -> None:
    torch.manual_seed(0)
    rows, online, target = transitions(), random_network(), random_network()
    loss = AdditiveDQNLoss(online)
    SoftUpdate(loss, tau=0.5)  # without one, TorchRL warns
    loss.target_qvalue_network_params.data.update_(TensorDict.from_module(target).data)
    with torch.no_grad():
        following = rows["next"].select(*KEYS)
        best = online(following.clone())["sensor_value"] > 0
        slow = target(following.clone())
        base, sensor = slow["base"], slow["sensor_value"]
        future, other = joint_value(base, sensor, best), joint_value(base, sensor, sensor > 0)
        value = rows["next", "reward"].squeeze(-1) + rows["discount"] * future * ~rows[
            "next", "terminated"
        ].squeeze(-1)
        own = online(rows.select(*KEYS))
        error = value - joint_value(own["base"], own["sensor_value"], rows["action"])
    assert (future < other - 1e-3).any()
    assert rows["next", "terminated"].any()
    result = loss(rows)
    torch.testing.assert_close(result["loss"], error.square().mean())
    torch.testing.assert_close(rows["td_error"], error.abs())
    rows["priority_weight"] = torch.rand(len(rows))
    torch.testing.assert_close(
        loss(rows)["loss"], (rows["priority_weight"] * error.square()).mean()
    )


def test_only_the_online_network_is_trained() -> None:
    loss = AdditiveDQNLoss(random_network())
    SoftUpdate(loss, tau=0.5)
    loss(transitions())["loss"].backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in loss.parameters())
    assert all(p.grad is None for p in loss.target_qvalue_network_params.flatten_keys().values())


def test_the_evaluated_network_follows_slowly() -> None:
    torch.manual_seed(0)
    learner = algorithm(
        "dqn", WORLD, "algo.updates=1", "algo.target_tau=0.25", "algo.batch_size=64"
    )
    start = [p.detach().clone() for p in learner.parameters]
    learner.step(collect(WORLD, learner.policy, 32, 8))
    slowly = list(learner.actor.parameters())
    for first, online, slow in zip(start, learner.parameters, slowly, strict=True):
        torch.testing.assert_close(slow, first + 0.25 * (online - first))


def test_exploration_and_learning_rate_follow_their_schedules() -> None:
    settings = (
        "algo.epsilon={start: 0.4, end: 0, begin: 0, until: 0.5}",
        "algo.learning_rate={start: 0.01, end: 0.002, begin: 0, until: 1}",
        "algo.batch_size=8",
        "algo.updates=1",
    )
    learner = algorithm("dqn", WORLD, *settings)
    assert learner.explore.epsilon.item() == pytest.approx(0.4)
    seen = [learner.step(collect(WORLD, learner.policy, 4, 4)) for _ in range(16)]
    assert [d["epsilon"] for d in seen] == pytest.approx(
        [0.4 * (1 - i / 8) for i in range(8)] + [0.0] * 8
    )
    assert [d["learning_rate"] for d in seen] == pytest.approx(
        [0.01 - 0.008 * i / 16 for i in range(16)]
    )
    assert learner.explore.epsilon.item() == 0.0


def test_prioritised_replay_learns_the_errors_it_saw() -> None:
    torch.manual_seed(0)
    settings = (
        "algo.prioritized.enabled=true",
        "algo.prioritized.alpha=1",
        "algo.updates=1",
        "algo.batch_size=32",
    )
    learner = algorithm("dqn", WORLD, *settings, "algo.buffer_size=256")
    learner.step(collect(WORLD, learner.policy, 32, 8))
    mass = learner.buffer.sampler.state_dict()["mass"]
    updated = mass != 1.0
    assert 10 < updated.sum() <= 32


def test_it_goes_on_learning_without_new_frames() -> None:
    learner = algorithm("dqn", WORLD, "algo.batch_size=32", "algo.updates=1")
    learner.step(collect(WORLD, learner.policy, 32, 8))
    before = [p.detach().clone() for p in learner.parameters]
    learner.step(None)
    assert any(not torch.equal(p, q) for p, q in zip(before, learner.parameters, strict=True))
    assert len(learner.buffer) == 256
