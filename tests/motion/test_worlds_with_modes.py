"""Worlds with a hidden mode: every memory and sensor, the environment, and whose policies they take."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.helpers import configured
from trackmdp.environment.env import TrackEnv
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.motion.modes import (
    heading_kernel,
)
from trackmdp.policies.policy import Policy
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.configured import make_problem
from trackmdp.world.model import World


@pytest.mark.parametrize(
    "words",
    [
        ["kernel.reveals=true", "task.memory=displacement", "task.clip=1"],
        ["grid.window=1", "task.memory=displacement", "task.clip=1"],
        ["grid.max_steps=5"],
        ["sensor=miss", "sensor.p_d=0.7", "sensor.p_s=0.8"],
        ["sensor=footprint", "sensor.radius=1", "sensor.p_d=0.7"],
    ],
)
def test_modes_go_with_every_memory_and_sensor(words: list[str]) -> None:
    """The exact value is that of 2,000 episodes, within 3 standard errors."""
    world = make_problem(
        configured("evaluate", "kernel=heading", "grid.size=3", "baseline=none", *words)
    )
    shape = (world.num_keys, world.num_choices, world.total_sensors)
    on = (np.random.default_rng(0).random(shape) < 0.5) & Policy.all_on(world).dense()
    policy = Policy.from_dense(world, on)
    played = simulate(world, policy, 2000, seed=1).figures().aihtr
    assert abs(played.mean - evaluate(world, policy).aihtr) < 3 * played.standard_error


# A mode that a detection tells.


def test_the_environment_tells_the_mode() -> None:
    """Sensors on at random: at a detection, and there alone, the key becomes the cell and the mode."""
    kernel, modes = heading_kernel(3, keep=0.7, go=0.9, exit_probability=0.05)
    world = World(kernel, 3, modes=modes, cost=0.1, t_max=1, revealed=8)
    env, generator = TrackEnv(world, 16, seed=3), torch.Generator().manual_seed(0)
    state = env.reset()
    assert (world.num_keys, env.observation_spec["key"].n) == (72, 72)
    assert torch.equal(state["key"], env.snapshot()["rows"]["place"])
    for _ in range(40):
        before = state["key"]
        state["action"] = torch.rand(16, 9, generator=generator) < 0.4
        frame, state = env.step_and_maybe_reset(state)
        after, ended = frame["next"], frame["next", "done"].squeeze(-1)
        located = (after["steps_since_detection"] == 0) & ~after["terminated"].squeeze(-1)
        hidden = env.snapshot()["rows"]["place"]
        assert torch.equal(state["key"][ended | located], hidden[ended | located])
        assert torch.equal(state["key"][~ended & ~located], before[~ended & ~located])


def test_a_policy_for_other_modes_is_refused() -> None:
    world = World(np.full((4, 4), 0.2), 2, cost=0.1, t_max=1)
    kernel, modes = heading_kernel(2, keep=0.7, go=0.9, exit_probability=0.05)
    told = World(kernel, 2, modes=modes, cost=0.1, t_max=1, reveals=True)
    with pytest.raises(UserError, match="made for targets with 8 modes; expected 1"):
        evaluate(world, Policy.all_on(told))
    with pytest.raises(UserError, match="revealed=3: expected 1 or 8"):
        World(kernel, 2, modes=modes, cost=0.1, t_max=1, revealed=3)
