"""Evaluating by chains and by simulation: the two agree, and neither disturbs what is evaluated."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.helpers import ALGORITHMS, BASELINES, algorithm, collect, evaluate_config, hop_world, limited, small_world
from trackmdp.build import make_baseline
from trackmdp.policies.fixed import AllOn, ChainPolicy, RandomK
from trackmdp.policies.policy import Policy
from trackmdp.training.evaluate import Simulation, chains_of, simulate
from trackmdp.training.evaluator import ExactEvaluator
from trackmdp.world.make import build_world
from trackmdp.world.model import World

STATE = ["last_cell", "steps_since_detection", "action_history"]
FIGURES = ("aihtr", "accuracy", "sensors_per_step", "safe_per_episode", "expected_length")


def scrambled(m: int) -> TensorDictModule:
    """A deterministic actor whose subset depends on the last cell, the misses, and every bit of the history."""

    def act(cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        weights = torch.arange(1, history[0].numel() + 1)
        seen = (history.flatten(1) * weights).sum(-1) + 31 * cell + 17 * n
        return ((seen[:, None] + 1) * torch.tensor([71, 113, 137, 193, 239, 293, 379, 419, 431][:m])) % 101 < 33

    return TensorDictModule(act, in_keys=STATE, out_keys=["action"])


def test_chains_are_the_sets_along_a_row_of_misses() -> None:
    world, actor = small_world(t_max=3), scrambled(9)
    chains = chains_of(actor, world.task)
    assert chains.shape == (9, 4, 9)
    assert chains.dtype == np.bool_
    for cell in range(9):
        history = torch.zeros(1, 4, 9, dtype=torch.bool)
        for n in range(4):
            rows = {"last_cell": torch.tensor([cell]), "steps_since_detection": torch.tensor([n])}
            action = actor(TensorDict({**rows, "action_history": history.clone()}, [1]))["action"][0]
            assert chains[cell, n].tolist() == action.tolist()
            history[0, n] = action
    assert len({chains[x, n].tobytes() for x in range(9) for n in range(4)}) > 20


@pytest.mark.parametrize("name", ["scrambled", *ALGORITHMS])
def test_chains_are_what_the_actor_does_in_the_environment(name: str) -> None:
    world = small_world(t_max=2)
    torch.manual_seed(0)
    if name == "scrambled":
        actor: Any = scrambled(9)
    else:
        actor = algorithm(name, world).actor
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.normal_(std=0.5)
    chains = torch.as_tensor(chains_of(actor, world.task))
    batch = collect(world, _evaluated(actor), 100, 40)
    free = batch["steps_since_detection"] <= 2
    followed = chains[batch["last_cell"][free], batch["steps_since_detection"][free]]
    assert torch.equal(batch["action"][free], followed)
    if name == "scrambled":
        assert {0, 1, 2} <= set(batch["steps_since_detection"].unique().tolist())


def _evaluated(actor: Any) -> Callable[[TensorDict], TensorDict]:
    def act(rows: TensorDict) -> TensorDict:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return rows.set("action", actor(rows.select(*STATE))["action"])

    return act


def assert_close(world: World, chains: np.ndarray, simulation: Simulation) -> None:
    """Every figure within four standard errors of the exact one."""
    exact = ExactEvaluator(world).evaluate(Policy.from_dense(world, chains))
    for key in FIGURES:
        estimate, value = getattr(simulation, key), getattr(exact, key)
        assert abs(estimate.mean - value) <= 4 * estimate.standard_error + 1e-5 * (1 + abs(value)), key
        assert estimate.standard_error < 0.05 * (1 + abs(value)), key


@pytest.mark.parametrize("max_steps", [None, 4])
@pytest.mark.parametrize("name", BASELINES)
def test_exact_and_simulated_figures_agree_for_every_baseline(name: str, max_steps: int | None) -> None:
    words = ("grid.size=3", "grid.t_max=2", "kernel.exit_probability=0.2", "cost.sensor=0.25", f"baseline={name}")
    cfg = evaluate_config(*words)
    world = limited(build_world(cfg), max_steps)
    chains = make_baseline(cfg.baseline, world)
    policy: Any = ChainPolicy(chains)
    if chains.dtype != np.bool_:
        policy = RandomK(9, cfg.baseline.k, torch.Generator().manual_seed(1))
    assert_close(world, chains, simulate(world, policy, episodes=20_000, seed=3))


def test_exact_and_simulated_figures_agree_for_a_learned_actor() -> None:
    world = small_world(t_max=2, exit_probability=0.3)
    torch.manual_seed(0)
    actor = algorithm("ppo", world).actor
    with torch.no_grad():
        actor.module[0].module.network.head.weight.normal_(std=0.3)
    simulation = simulate(world, actor, episodes=20_000, seed=0)
    assert simulation.safe_per_episode.mean > 0.05
    assert 0.2 < simulation.accuracy.mean < 0.9
    assert_close(world, chains_of(actor, world.task), simulation)


def test_prices_per_cell_and_a_cheap_safe_action() -> None:
    """2x2, T_max 1, r = 2, c = 0.1 ... 0.4, D = 0.9."""
    world = hop_world()
    chains = np.random.default_rng(3).random((4, 2, 4)) < 0.4
    assert_close(world, chains, simulate(world, ChainPolicy(chains), episodes=50_000, seed=0))


def test_every_row_counts_up_to_its_first_end() -> None:
    """The target hops with probability 3/4: lengths are geometric, the share of episodes of one step is 1/4."""
    simulation = simulate(hop_world(), AllOn(4), episodes=40_000, seed=1)
    assert simulation.episodes == 40_000
    assert simulation.expected_length.mean == pytest.approx(4.0, abs=4 * simulation.expected_length.standard_error)
    assert simulation.expected_length.standard_error == pytest.approx(math.sqrt(12 / 40_000), rel=0.05)
    assert simulation.accuracy.mean == 1.0
    assert simulation.sensors_per_step.mean == 4.0
    assert simulation.aihtr.mean == pytest.approx(3.0, abs=4 * simulation.aihtr.standard_error)


def test_standard_errors_are_those_of_independent_runs() -> None:
    """Over 200 simulations of 200 episodes, the estimates spread as their standard errors say."""
    world, chains = small_world(t_max=1, exit_probability=0.4), np.zeros((9, 2, 9), dtype=bool)
    chains[:, :, :5] = True
    runs = [simulate(world, ChainPolicy(chains), episodes=200, seed=seed) for seed in range(200)]
    for key in FIGURES:
        estimates = [getattr(run, key) for run in runs]
        spread = np.std([estimate.mean for estimate in estimates])
        claimed = np.mean([estimate.standard_error for estimate in estimates])
        assert spread == pytest.approx(claimed, rel=0.2), key


def test_a_single_episode_has_no_standard_error() -> None:
    simulation = simulate(hop_world(), AllOn(4), episodes=1, seed=0)
    for field in dataclasses.fields(simulation):
        if field.name != "episodes":
            assert math.isnan(getattr(simulation, field.name).standard_error)
    assert simulation.expected_length.mean >= 1


def test_a_target_that_leaves_at_once_has_no_accuracy() -> None:
    world = World(np.zeros((4, 4)), 2, cost=np.full(4, 0.1), safe_cost=0.4, t_max=1)
    simulation = simulate(world, AllOn(4), episodes=10, seed=0)
    assert simulation.expected_length.mean == 1.0
    assert simulation.aihtr.mean == 0.0
    assert math.isnan(simulation.accuracy.mean)
    assert math.isnan(simulation.episode_accuracy.mean)


def test_simulation_is_decided_by_its_seed() -> None:
    world, chains = small_world(), np.random.default_rng(0).random((9, 2, 9)) < 0.5
    first, again, other = (simulate(world, ChainPolicy(chains), episodes=50, seed=seed) for seed in (0, 0, 1))
    assert first == again
    assert first != other


@pytest.mark.parametrize("name", ALGORITHMS)
def test_evaluating_does_not_disturb_training(name: str) -> None:
    """Three iterations with and without chains and simulations between them: the same bits in every tensor."""
    world, states = small_world(), []
    for evaluated in (False, True):
        torch.manual_seed(5)
        learner = algorithm(name, world)
        for seed in range(3):
            learner.step(collect(world, learner.policy, 32, 8, seed=seed))
            if evaluated:
                chains_of(learner.actor, world.task)
                simulate(world, learner.actor, episodes=20, seed=0)
                simulate(world, learner.policy, episodes=20, seed=0)
        states.append(TensorDict.from_dict(_tensors(learner.state_dict())))
    assert (states[0] == states[1]).all()


def _tensors(state: Any, key: str = "") -> dict[str, torch.Tensor]:
    if isinstance(state, torch.Tensor):
        return {key: state}
    pairs = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, (list, tuple)) else ()
    found: dict[str, torch.Tensor] = {}
    for name, value in pairs:
        found |= _tensors(value, f"{key}/{name}")
    return found
