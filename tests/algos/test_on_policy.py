"""What A2C and PPO learn from: advantages against hand values, and no credit for forced steps."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

import trackmdp as tm
from tests.helpers import algorithm, collect, hop_world, small_world
from trackmdp.algos.on_policy import price
from trackmdp.policies.actor_critic import SubsetDistribution

ON_POLICY = ["a2c", "ppo"]
GAMMA, LAMBDA, SCALE, CONSTANT = 0.8, 0.5, 0.1, 3.0
# The hops earn 2, the unit of rewards.
SETTINGS = (f"algo.gamma={GAMMA}", f"algo.gae_lambda={LAMBDA}", f"algo.reward_scale={2 * SCALE}")


def frames(terminated: list[int], truncated: list[int], misses: list[int]) -> TensorDict:
    """One row of four steps with rewards 10, 20, 30, 40; all sensors are on, with certainty."""
    ends, cuts = (
        torch.tensor(flags, dtype=torch.bool).reshape(1, 4, 1) for flags in (terminated, truncated)
    )
    state = {
        "last_cell": torch.tensor([[0, 1, 2, 3]]),
        "steps_since_detection": torch.tensor([misses]),
        "action_history": torch.zeros(1, 4, 2, 4, dtype=torch.bool),
    }
    following = {**state, "reward": torch.tensor([[[10.0], [20.0], [30.0], [40.0]]])}
    following |= {"terminated": ends, "truncated": cuts, "done": ends | cuts}
    action = {"action": torch.ones(1, 4, 4, dtype=torch.bool), "action_log_prob": torch.zeros(1, 4)}
    action["logits"] = torch.full((1, 4, 4), 200.0)
    return TensorDict({**state, **action, "next": TensorDict(following, [1, 4])}, [1, 4])


def constant_critic(name: str) -> object:
    learner = algorithm(name, hop_world(), *SETTINGS)
    with torch.no_grad():
        learner.critic.module.head.weight.zero_()
        learner.critic.module.head.bias.fill_(CONSTANT)
    return learner


def advantages(errors: list[float], ends: list[bool]) -> list[float]:
    """A_t = δ_t + γλ A_{t+1}, started anew after the end of an episode."""
    following, found = 0.0, []
    for error, end in zip(reversed(errors), reversed(ends), strict=True):
        following = error + (0.0 if end else GAMMA * LAMBDA * following)
        found.append(following)
    return found[::-1]


@pytest.mark.parametrize("name", ON_POLICY)
@pytest.mark.parametrize("flag", ["none", "terminated", "truncated"])
def test_the_advantage_at_the_end_of_an_episode(name: str, flag: str) -> None:
    """With V = 3 everywhere, δ = r/10 + 0.8·3 - 3, but r/10 - 3 where the target has exited; truncation bootstraps."""
    flags = {kind: [0, int(flag == kind), 0, 0] for kind in ("terminated", "truncated")}
    batch = frames(**flags, misses=[0, 1, 0, 0])
    constant_critic(name).prepare(batch)
    bootstrap = [GAMMA * CONSTANT * (not ended) for ended in flags["terminated"]]
    errors = [r + v - CONSTANT for r, v in zip([1.0, 2.0, 3.0, 4.0], bootstrap, strict=True)]
    expected = torch.tensor(advantages(errors, [False, flag != "none", False, False]))
    torch.testing.assert_close(batch["advantage"].flatten(), expected)
    torch.testing.assert_close(batch["value_target"].flatten(), expected + CONSTANT)


@pytest.mark.parametrize("name", ON_POLICY)
def test_forced_steps_get_no_credit_and_count_for_nothing(name: str) -> None:
    """T_max = 1, so the step at n = 2 is forced; the one at n = 1 is alone, which tells nothing."""
    batch = frames([0, 0, 0, 1], [0] * 4, misses=[0, 1, 2, 0])
    data, _ = constant_critic(name).prepare(batch)
    raw, normalised = batch["advantage"].flatten(), data["advantage"].flatten()
    assert normalised[1] == normalised[2] == 0.0
    half = 2**-0.5  # two values with mean 0 and variance 1
    expected = half if raw[0] > raw[3] else -half
    torch.testing.assert_close(normalised[[0, 3]], torch.tensor([expected, -expected]))


@pytest.mark.parametrize("name", ON_POLICY)
def test_the_advantage_is_normalised_at_each_n_by_itself(name: str) -> None:
    batch = frames([0, 0, 0, 1], [0] * 4, misses=[0, 1, 0, 1])
    data, _ = constant_critic(name).prepare(batch)
    raw, normalised = batch["advantage"].flatten(), data["advantage"].flatten()
    for rows in ([0, 2], [1, 3]):
        torch.testing.assert_close(normalised[rows].abs(), torch.full((2,), 2**-0.5))
        assert normalised[rows].sum().item() == pytest.approx(0.0, abs=1e-6)
        assert (normalised[rows[0]] > 0) == (raw[rows[0]] > raw[rows[1]])


@pytest.mark.parametrize("name", ON_POLICY)
@pytest.mark.parametrize("misses", [0, 2])
def test_a_single_frame_and_a_batch_of_forced_steps_stay_finite(name: str, misses: int) -> None:
    learner = constant_critic(name)
    batch = frames([0] * 4, [0] * 4, [misses] * 4)[:, :1]
    data, diagnostics = learner.prepare(batch)
    assert data["advantage"].tolist() == [[0.0]]
    assert all(value == value for value in diagnostics.values())


@pytest.mark.parametrize("name", ON_POLICY)
def test_schedules_follow_the_progress_of_the_run(name: str) -> None:
    schedule = ("algo.learning_rate={start: 0.4, end: 0.1, begin: 0, until: 1}",)
    learner = algorithm(
        name, small_world(), *schedule, "algo.entropy={start: 0.2, end: 0, begin: 0.5, until: 0.75}"
    )
    assert learner.iterations == 16
    seen = []
    for _ in range(16):
        _, diagnostics = learner.prepare(collect(small_world(), learner.policy, 2, 4))
        assert learner.optimizer.param_groups[0]["lr"] == diagnostics["learning_rate"]
        assert learner.loss.entropy_coeff.item() == pytest.approx(diagnostics["entropy_coef"])
        seen.append((diagnostics["learning_rate"], diagnostics["entropy_coef"]))
    rates, entropies = zip(*seen, strict=True)
    assert rates == pytest.approx([0.4 - 0.3 * i / 16 for i in range(16)])
    assert entropies == pytest.approx([0.2] * 9 + [0.15, 0.1, 0.05] + [0.0] * 4)


@pytest.mark.parametrize("name", ON_POLICY)
def test_the_expected_price_takes_the_place_of_the_price_paid(name: str) -> None:
    """Four sensors for .5 each are on, with probability 1/2: 1 less is expected; not where forced, nor at an exit."""
    learner = algorithm(name, replace(hop_world(), cost=0.5), *SETTINGS)
    batch = frames([0, 0, 0, 1], [0] * 4, misses=[0, 1, 2, 0])
    batch["logits"] = torch.zeros(1, 4, 4)
    data, _ = learner.prepare(batch)
    earned = torch.tensor([10.0 + 1.0, 20.0 + 1.0, 30.0, 40.0])
    torch.testing.assert_close(batch["next", "reward"].flatten(), SCALE * earned)
    # The row at n = 1 is alone and has no variance; at n = 0 the price counts as the advantage does.
    raw, weight = batch["advantage"].flatten(), data["price_weight"].flatten()
    assert weight[1:].tolist() == [0.0, 0.0, 0.0]
    assert weight[0].item() == pytest.approx(SCALE / raw[[0, 3]].std().item())


@pytest.mark.parametrize("name", ON_POLICY)
def test_exact_prices_leave_the_expected_gradient_as_it_is(name: str) -> None:
    """Of a bandit: over all sets, by their probabilities, the gradient is that of the expected reward."""
    world = tm.World(hop_world().kernel, 2, cost=[0.5, 0.1, 0.2, 0.3], t_max=0)
    learner = algorithm(name, world, "algo.reward_scale=1")
    logits = torch.tensor([0.3, -0.2, 0.1, 0.5], requires_grad=True)
    sets = torch.tensor(list(itertools.product([False, True], repeat=4)))
    dist = SubsetDistribution(logits.expand(16, 4))
    log_prob, rows = dist.log_prob(sets), TensorDict({"last_cell": torch.zeros(16).long()}, [16])
    gain = sets[:, 0].float() + sets[:, 1] * sets[:, 2]
    paid = price(learner.costs, rows, sets.float()).squeeze(-1)
    expected = price(learner.costs, rows, logits.sigmoid().expand(16, 4)).squeeze(-1)
    weight = log_prob.exp().detach()
    sampled = (weight * log_prob * (gain - paid)).sum()
    exact = (weight * (log_prob * gain - expected)).sum()
    wanted, found = (
        torch.autograd.grad(each, logits, retain_graph=True)[0] for each in (sampled, exact)
    )
    torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize("name", ON_POLICY)
def test_the_explained_variance_of_a_perfect_and_a_constant_critic(name: str) -> None:
    batch = frames([0] * 4, [0] * 4, [0] * 4)
    _, diagnostics = constant_critic(name).prepare(batch)
    assert diagnostics["explained_variance"] == pytest.approx(0.0, abs=1e-5)
