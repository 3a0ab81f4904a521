"""Sets of at most B sensors: the distribution against all sets one by one, and learners that keep to a budget."""

from __future__ import annotations

import itertools

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

import trackmdp as tm
from trackmdp.policies.few_sensors import FewSensors, greedy
from trackmdp.policies.qvalue import EpsilonFlip
from trackmdp.world.model import World


def all_sets(count: int, budget: int) -> Tensor:
    """`[sets, count]` bool."""
    every = torch.tensor(list(itertools.product([False, True], repeat=count)))
    return every[every.sum(-1) <= budget]


@pytest.mark.parametrize(("count", "budget"), [(1, 1), (4, 2), (5, 0), (6, 3), (7, 1)])
def test_probabilities_are_those_of_independent_sensors_given_the_count(
    count: int, budget: int
) -> None:
    logits = 3 * torch.randn(3, count, generator=torch.Generator().manual_seed(count))
    logits.requires_grad_()
    few, sets = FewSensors(logits, budget), all_sets(count, budget)
    alone = torch.distributions.Bernoulli(logits=logits.detach())
    weight = torch.stack([alone.log_prob(x.float()).sum(-1).exp() for x in sets], -1)  # type: ignore[no-untyped-call]
    share = weight / weight.sum(-1, keepdim=True)
    found = torch.stack([few.log_prob(each) for each in sets], -1)
    torch.testing.assert_close(found.exp(), share, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(few.mean, share @ sets.float(), atol=1e-6, rtol=1e-5)
    entropy = torch.special.entr(share).sum(-1)
    torch.testing.assert_close(few.entropy(), entropy, atol=1e-5, rtol=1e-4)
    slope = torch.autograd.grad(few.entropy().sum() + (few.mean * logits).sum(), logits)[0]
    assert torch.isfinite(slope).all()


def test_samples_occur_as_often_as_they_are_likely() -> None:
    torch.manual_seed(0)
    logits = torch.tensor([[2.0, -1.0, 0.5, 0.0, -3.0]])
    few = FewSensors(logits, 2)
    drawn = few.sample((20_000,))[:, 0]
    assert int(drawn.sum(-1).max()) == 2
    for each in all_sets(5, 2):
        share = (drawn == each).all(-1).double().mean()
        chance = float(few.log_prob(each).exp())
        assert abs(float(share) - chance) < 4 * (chance / 20_000) ** 0.5 + 1e-4


def test_large_logits_of_many_sensors_stay_finite() -> None:
    few = FewSensors(torch.full((2, 400), 60.0), 3)
    assert torch.isfinite(few.log_prob(few.sample())).all()
    assert few.sample().sum(-1).tolist() == [3, 3]
    torch.testing.assert_close(few.mean, torch.full((2, 400), 3 / 400))
    assert FewSensors(torch.full((1, 9), -80.0), 3).sample().sum() == 0


def test_the_mode_and_explored_sets_keep_to_the_budget() -> None:
    value = torch.tensor([[0.1, 3.0, -1.0, 2.0, 0.0]])
    assert greedy(value, 2).tolist() == [[False, True, False, True, False]]
    assert greedy(value, None).tolist() == [[True, True, False, True, False]]
    assert FewSensors(value, 1).mode.tolist() == [[False, True, False, False, False]]
    flip = EpsilonFlip(0.9, budget=2)
    rows = TensorDict({"sensor_value": value.expand(500, 5), "last_cell": torch.zeros(500)}, 500)
    with set_exploration_type(ExplorationType.RANDOM):
        chosen = flip(rows)["action"]
    assert int(chosen.sum(-1).max()) == 2
    assert chosen[:, [0, 2]].any(0).all()  # also useless ones are tried
    assert not chosen[:, 4].any()  # a sensor without a value stays off


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "share"), [("a2c", 0.5), ("ppo", 0.5), ("dqn", None)])
def test_networks_learn_within_a_budget(algo: str, share: float | None) -> None:
    world = tm.make_world(size=3, t_max=0, budget=2, exit_probability=0.1, safe_cost=0.5)
    assert isinstance(world, World)
    run = tm.train(world, algo, seed=0, **{"collector.total_frames": 40_000, "log": []})  # type: ignore[arg-type]
    assert run.policy.most_on <= 2
    if share is not None:  # dqn needs more frames, with a budget and without one
        best, none = tm.solve(world).lower, tm.evaluate(world, "none").aihtr
        assert run.evaluation.aihtr > none + share * (best - none)
