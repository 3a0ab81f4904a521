"""Subset distribution against all 2^M subsets, actor and critic on a state."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from scipy import stats
from tensordict.nn import set_interaction_type
from tensordict.nn.probabilistic import InteractionType

from tests.helpers import random_state, small_world
from trackmdp.policies.actor_critic import SubsetDistribution, make_actor, make_critic

SUBSETS = torch.tensor(list(itertools.product([False, True], repeat=3)))
LOGITS = torch.tensor([[-1.0, 0.3, 2.0], [0.0, -0.2, 0.1], [4.0, -5.0, 0.5]], dtype=torch.float64)


def probabilities(logits: torch.Tensor) -> torch.Tensor:
    """`[8]` each subset's probability, one factor per sensor."""
    on = 1 / (1 + torch.exp(-logits))
    return torch.where(SUBSETS, on, 1 - on).prod(-1)


@pytest.mark.parametrize("row", range(3))
def test_log_prob_entropy_and_mode_against_all_subsets(row: int) -> None:
    logits = LOGITS[row]
    subsets = SubsetDistribution(logits)
    p = probabilities(logits)
    torch.testing.assert_close(p.sum(), torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(SubsetDistribution(logits.expand(8, 3)).log_prob(SUBSETS), p.log())
    torch.testing.assert_close(subsets.entropy(), -(p * p.log()).sum())
    best = SUBSETS[p.argmax()]
    assert torch.equal(subsets.mode, best) or p[0] == p.max()
    assert torch.equal(subsets.deterministic_sample, subsets.mode)


def test_a_batch_is_its_rows() -> None:
    subsets = SubsetDistribution(LOGITS)
    for row in range(3):
        alone = SubsetDistribution(LOGITS[row])
        torch.testing.assert_close(subsets.entropy()[row], alone.entropy())
        torch.testing.assert_close(subsets.log_prob(SUBSETS[:3])[row], alone.log_prob(SUBSETS[row]))


def test_extreme_logits_stay_finite() -> None:
    subsets = SubsetDistribution(torch.tensor([200.0, -200.0, 0.0], requires_grad=True))
    value = subsets.log_prob(torch.tensor([False, True, True])) + subsets.entropy()
    value.backward()
    assert value.item() == pytest.approx(-400.0)


def test_gradients_are_those_of_the_formula() -> None:
    logits = LOGITS.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda z: SubsetDistribution(z).log_prob(SUBSETS[[1, 6, 3]]), logits
    )
    assert torch.autograd.gradcheck(lambda z: SubsetDistribution(z).entropy(), logits)


def test_sample_frequencies() -> None:
    torch.manual_seed(0)
    logits = LOGITS[0]
    sampled = SubsetDistribution(logits).sample(torch.Size([100_000]))
    assert sampled.dtype == torch.bool
    assert sampled.shape == (100_000, 3)
    counts = np.bincount((sampled * torch.tensor([4, 2, 1])).sum(-1), minlength=8)
    assert stats.chisquare(counts, 100_000 * probabilities(logits).numpy()).pvalue > 1e-3


def test_the_actor_writes_an_action_and_its_log_probability() -> None:
    world = small_world(t_max=1)
    torch.manual_seed(0)
    actor, rows = (
        make_actor(world.task, 16, initial_logit=-0.5),
        random_state(world, 40, seed=0).exclude("action"),
    )
    with torch.no_grad():
        acted = actor(rows.clone())
        assert acted["action"].shape == (40, 9)
        assert acted["action"].dtype == torch.bool
        subsets = SubsetDistribution(acted["logits"])
        torch.testing.assert_close(acted["action_log_prob"], subsets.log_prob(acted["action"]))
        assert ((acted["logits"] + 0.5).abs() < 0.1).all()
        with set_interaction_type(InteractionType.DETERMINISTIC):
            judged = actor(rows.clone())
    assert torch.equal(judged["action"], judged["logits"] > 0)


def test_the_critic_writes_one_value_per_state() -> None:
    world = small_world(t_max=1)
    rows = random_state(world, 40, seed=0)
    value = make_critic(world.task, 16)(rows)["state_value"]
    assert value.shape == (40, 1)
    assert value.dtype == torch.float32
