"""A2C, PPO and DQN with a joint credit, and the learned kernel, where a window limits the sensors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import trackmdp
from tests.helpers import algorithm, collect, random_state, small_world
from trackmdp.motion.kernels import random_walk
from trackmdp.policies.policy import Policy
from trackmdp.sensing.windows import Window
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.world.model import World

JOINT = ("a2c", "ppo", "dqn")


class Largest(TorchDispatchMode):
    """The number of entries of the largest tensor that an operation made."""

    entries = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        sizes = [part.numel() for part in tree_leaves(made) if isinstance(part, torch.Tensor)]
        self.entries = max([self.entries, *sizes])
        return made


def walk(size: int, window: int | None) -> World:
    kernel = random_walk(size, stay=0.2, diagonal=True, exit_probability=0.02, border="renormalize")
    return World(kernel, size, cost=0.1, t_max=1, window=window)


@pytest.mark.parametrize("name", JOINT)
def test_nothing_is_as_large_as_the_pairs_of_cells(name: str) -> None:
    world = walk(30, window=1)
    with Largest() as made:
        learner = algorithm(name, world)
        batch = collect(world, learner.policy, 32, 8)
        learner.step(batch.clone())
    assert batch["action"].shape == (32, 8, 9)
    assert batch["action_history"].shape == (32, 8, 2, 9)
    assert 2 * 9 * 256 <= made.entries < 900 * 900


@pytest.mark.parametrize("name", JOINT)
def test_sensors_outside_the_grid_are_never_on(name: str) -> None:
    """Not even in a policy that has nearly all others on, nor while it explores."""
    torch.manual_seed(0)
    world = replace(small_world(size=4, t_max=1), window=1)
    learner = algorithm(
        name, world, "algo.epsilon.start=0.5" if name == "dqn" else "algo.initial_logit=5"
    )
    batch = collect(world, learner.policy, 32, 16)
    acted = learner.actor(random_state(world, 200, seed=0).exclude("action"))
    window = Window.of(world)
    for rows in (batch.reshape(-1), acted):
        inside = window.inside(rows["last_cell"])
        assert not rows["action"][~inside].any()
        assert rows["action"][inside].float().mean() > (0.3 if name == "dqn" else 0.6)
    learner.step(batch)
    assert all(torch.isfinite(part).all() for part in learner.parameters)
    sets = Policy.from_module(world, learner.actor).sets  # refuses sensors that cannot be chosen
    assert sets.shape == (32, 16)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "frames"), [*((name, 200_000) for name in JOINT), ("model_based", 20_000)]
)
def test_they_learn_what_is_best_in_the_window(name: str, frames: int) -> None:
    """Where the window matters: some moves lead out of it. With all of its sensors on, the regret is 0.48."""
    world = trackmdp.make_world("random_support", size=5, t_max=1, cost=0.16, window=1)
    best = evaluate(world, trackmdp.solve(world).policy).aihtr
    everywhere = replace(world, window=None)
    assert best < evaluate(everywhere, trackmdp.solve(everywhere).policy).aihtr - 0.01
    run = trackmdp.train(world, name, total_frames=frames, optimal={"enabled": False})
    assert regret_per_step(best, run.evaluation) < 0.1
