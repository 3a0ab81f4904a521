"""The environment with a window: the same episodes, in local numbers; and batches of any shape."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchrl.envs.utils import check_env_specs

from tests.helpers import advanced, random_state, small_world, worlds
from trackmdp.environment.env import TrackEnv
from trackmdp.motion.kernels import random_walk
from trackmdp.sensing.windows import Window
from trackmdp.world.model import World

SHAPES = [(), (1,), (6,), (3, 2), (2, 1, 3)]


def walk(window: int | None, size: tuple[int, int] = (5, 4), t_max: int = 2) -> World:
    kernel = random_walk(size, stay=0.2, diagonal=True, exit_probability=0.1, border="clip")
    cost = torch.linspace(0.1, 0.3, size[0] * size[1]).numpy()
    return World(kernel, size, cost=cost, t_max=t_max, window=window)


def everywhere(world: World, state: Any) -> dict[str, torch.Tensor]:
    """The same state in global numbers."""
    window, start = Window.of(world), state["last_cell"]
    slots = start[:, None].expand(-1, world.num_choices)
    found = {key: state[key] for key in ("place", "last_cell", "steps_since_detection")}
    found["action_history"] = window.to_global(slots, state["action_history"])
    return found | (
        {"action": window.to_global(start, state["action"])} if "action" in state else {}
    )


@given(worlds(), st.integers(0, 3), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_a_step_with_a_window_is_the_one_without(
    world: World, radius: int, rows: int, seed: int
) -> None:
    """The same target, sets within the window: the same reward to the bit, and the same state after it."""
    local = replace(world, window=radius)
    state = random_state(local, rows, seed)
    draws = torch.rand(rows, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    mine = advanced(local, state, draws)
    theirs = advanced(world, everywhere(local, state), draws)
    assert set(mine) == set(theirs)
    for key, value in (mine | everywhere(local, mine)).items():
        assert torch.equal(value, theirs[key]), key


def test_whole_episodes_with_and_without_a_window_are_the_same() -> None:
    """Radius 1 on 5 x 4 cells and a policy that senses at most the eight cells around: 300 steps of 40 targets."""
    local, whole = TrackEnv(walk(1), 40, seed=3), TrackEnv(walk(None), 40, seed=3)
    window, rng = Window((5, 4), 1), torch.Generator().manual_seed(0)
    mine, theirs, missed = local.reset(), whole.reset(), 0
    for _ in range(300):
        action = torch.rand(40, 9, generator=rng) < 0.6
        mine["action"], theirs["action"] = action, window.to_global(mine["last_cell"], action)
        (ours, mine), (others, theirs) = (
            local.step_and_maybe_reset(mine),
            whole.step_and_maybe_reset(theirs),
        )
        assert torch.equal(local.target, whole.target)
        assert torch.equal(mine["last_cell"], theirs["last_cell"])
        assert torch.equal(ours["next", "reward"], others["next", "reward"])
        missed += int((ours["next", "steps_since_detection"] > 0).sum())
    assert missed > 1000


def test_the_safe_action_locates_outside_the_window() -> None:
    """One row of 5 cells, radius 1: the target is four cells away, and only when forced it is located."""
    kernel = random_walk((1, 5), stay=1.0, diagonal=False, exit_probability=0.0, border="clip")
    world = World(kernel, (1, 5), cost=0.1, t_max=0, max_steps=99, window=1)
    state = {
        "place": torch.tensor([4]),
        "last_cell": torch.tensor([0]),
        "steps_since_detection": torch.tensor([0]),
        "action_history": torch.zeros(1, 1, 9, dtype=torch.bool),
        "action": torch.ones(1, 9, dtype=torch.bool),
        "step_count": torch.tensor([0]),
    }
    missed = advanced(world, state, [0.0])
    assert missed["reward"].item() == pytest.approx(
        -0.2
    )  # cells 0 and 1; all others of the window lie outside
    assert missed["steps_since_detection"].tolist() == [1]
    located = advanced(world, missed | {"action": state["action"]}, [0.0])
    assert located["last_cell"].tolist() == [4]
    assert located["reward"].item() == pytest.approx(1.0 - 0.5)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("window", "max_steps"), [(None, None), (1, 3)])
def test_specs_hold_for_every_shape(
    shape: tuple[int, ...], window: int | None, max_steps: int | None
) -> None:
    env = TrackEnv(replace(walk(window), max_steps=max_steps), shape)
    check_env_specs(env)
    assert env.action_spec.shape == (*shape, 20 if window is None else 9)
    assert env.rollout(4, break_when_any_done=False)["action_history"].shape == (
        *shape,
        4,
        3,
        env.action_spec.shape[-1],
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_a_batch_of_any_shape_is_the_row_of_its_targets(shape: tuple[int, ...]) -> None:
    count = torch.Size(shape).numel()
    shaped, row = (TrackEnv(small_world(t_max=2), size, seed=1) for size in (shape, count))
    mine, theirs, rng = shaped.reset(), row.reset(), torch.Generator().manual_seed(0)
    for _ in range(30):
        action = torch.rand(count, 9, generator=rng) < 0.4
        mine["action"], theirs["action"] = action.reshape(*shape, 9), action
        (ours, mine), (others, theirs) = (
            shaped.step_and_maybe_reset(mine),
            row.step_and_maybe_reset(theirs),
        )
        for done, expected in ((ours, others), (mine, theirs)):
            assert done.batch_size == shape
            assert (
                (done == expected.reshape(shape)).all()
                if shape
                else (done.unsqueeze(0) == expected).all()
            )
