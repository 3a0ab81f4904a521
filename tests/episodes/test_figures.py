"""Figures of simulated episodes: they agree with the exact ones, and their standard errors are honest."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.helpers import BASELINES, algorithm, evaluate_config, hop_world, limited, small_world
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.simulated_figures import Simulation
from trackmdp.policies.policy import Policy
from trackmdp.solvers.solve import baseline_policy
from trackmdp.training.evaluator import ExactEvaluator
from trackmdp.world.configured import build_world
from trackmdp.world.model import World

FIGURES = ("aihtr", "accuracy", "sensors_per_step", "safe_per_episode", "expected_length")


def assert_close(world: World, policy: Policy, simulation: Simulation) -> None:
    """Every figure within four standard errors of the exact one."""
    exact = ExactEvaluator(world).evaluate(policy)
    for key in FIGURES:
        estimate, value = getattr(simulation, key), getattr(exact, key)
        assert abs(estimate.mean - value) <= 4 * estimate.standard_error + 1e-5 * (
            1 + abs(value)
        ), key
        assert estimate.standard_error < 0.05 * (1 + abs(value)), key


@pytest.mark.parametrize("max_steps", [None, 4])
@pytest.mark.parametrize("name", BASELINES)
def test_exact_and_simulated_figures_agree_for_every_baseline(
    name: str, max_steps: int | None
) -> None:
    words = (
        "grid.size=3",
        "grid.t_max=2",
        "kernel.exit_probability=0.2",
        "cost.sensor=0.25",
        f"baseline={name}",
    )
    cfg = evaluate_config(*words)
    world = limited(build_world(cfg), max_steps)
    policy = baseline_policy(world, cfg.baseline)
    assert_close(world, policy, simulate(world, policy, 4_000, seed=3).figures())


def test_exact_and_simulated_figures_agree_for_a_learned_actor() -> None:
    world = small_world(t_max=2, exit_probability=0.3)
    torch.manual_seed(1)
    actor = algorithm("ppo", world).actor
    with torch.no_grad():
        actor.module[0].module.network.head.weight.normal_(std=0.3)
    mode = Policy.from_module(world, actor)
    simulation = simulate(world, mode, 10_000).figures()
    assert simulation.safe_per_episode.mean > 0.05
    assert 0.2 < simulation.accuracy.mean < 0.9
    assert_close(world, mode, simulation)


def test_prices_per_cell_and_a_cheap_safe_action() -> None:
    """2x2, T_max 1, r = 2, c = 0.1 ... 0.4, D = 0.9."""
    world = hop_world()
    policy = Policy.from_dense(world, np.random.default_rng(3).random((4, 2, 4)) < 0.4)
    assert_close(world, policy, simulate(world, policy, 20_000).figures())


def test_a_function_that_draws_is_simulated_with_the_history_it_has_made() -> None:
    """Each sensor on with probability 1/4, independently, but those that the history holds; asked at every step."""
    world, seen = small_world(t_max=2, exit_probability=0.2), []

    def drawing(last_cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        slots = torch.arange(3)
        assert not history[slots >= n[:, None]].any()
        seen.append(history[n == 2][:, :2].double().mean().item())
        return torch.rand(len(last_cell), 9) < 0.25

    episodes = simulate(world, drawing, 5_000, seed=1)
    exact = Policy.from_dense(world, np.full((9, 3, 9), 0.25))
    assert_close(world, exact, episodes.figures())
    # A set that missed did not hold the target's cell: of nine sensors, eight are on with 1/4.
    assert np.nanmean(seen) == pytest.approx(0.25 * 8 / 9, abs=0.01)
    assert episodes.policy is None
    assert (
        simulate(world, drawing, 50, seed=1).figures()
        == simulate(world, drawing, 50, seed=1).figures()
    )


def test_every_row_counts_up_to_its_first_end() -> None:
    """The target hops with probability 3/4: lengths are geometric, the share of episodes of one step is 1/4."""
    simulation = simulate(hop_world(), Policy.all_on(hop_world()), 40_000, seed=1).figures()
    assert simulation.episodes == 40_000
    assert simulation.expected_length.mean == pytest.approx(
        4.0, abs=4 * simulation.expected_length.standard_error
    )
    assert simulation.expected_length.standard_error == pytest.approx(
        math.sqrt(12 / 40_000), rel=0.05
    )
    assert simulation.accuracy.mean == 1.0
    assert simulation.sensors_per_step.mean == 4.0
    assert simulation.aihtr.mean == pytest.approx(3.0, abs=4 * simulation.aihtr.standard_error)


def test_standard_errors_are_those_of_independent_runs() -> None:
    """Over 200 simulations of 200 episodes, the estimates spread as their standard errors say."""
    world, chains = small_world(t_max=1, exit_probability=0.4), np.zeros((9, 2, 9), dtype=bool)
    chains[:, :, :5] = True
    policy = Policy.from_dense(world, chains)
    runs = [simulate(world, policy, 200, seed=seed).figures() for seed in range(200)]
    for key in FIGURES:
        estimates = [getattr(run, key) for run in runs]
        spread = np.std([estimate.mean for estimate in estimates])
        claimed = np.mean([estimate.standard_error for estimate in estimates])
        assert spread == pytest.approx(claimed, rel=0.2), key


def test_a_single_episode_has_no_standard_error() -> None:
    simulation = simulate(hop_world(), Policy.all_on(hop_world()), 1).figures()
    for field in dataclasses.fields(simulation):
        if field.name != "episodes":
            assert math.isnan(getattr(simulation, field.name).standard_error)
    assert simulation.expected_length.mean >= 1


def test_a_target_that_leaves_at_once_has_no_accuracy() -> None:
    world = World(np.zeros((4, 4)), 2, cost=np.full(4, 0.1), safe_cost=0.4, t_max=1)
    simulation = simulate(world, Policy.all_on(world), 10).figures()
    assert simulation.expected_length.mean == 1.0
    assert simulation.aihtr.mean == 0.0
    assert math.isnan(simulation.accuracy.mean)


def test_simulation_is_decided_by_its_seed() -> None:
    world = small_world()
    policy = Policy.from_dense(world, np.random.default_rng(0).random((9, 2, 9)) < 0.5)
    first, again, other = (simulate(world, policy, 50, seed=seed).figures() for seed in (0, 0, 1))
    assert first == again
    assert first != other


def test_no_episode_has_no_figures() -> None:
    simulation = simulate(small_world(), Policy.all_on(small_world()), 0).figures()
    assert simulation.episodes == 0
    assert math.isnan(simulation.aihtr.mean)
