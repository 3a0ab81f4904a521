"""What a task and a world hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.helpers import hop_world
from trackmdp.errors import UserError
from trackmdp.sensing.task import Task
from trackmdp.world.group import Group
from trackmdp.world.make import load_tracks, make_world
from trackmdp.world.model import World


def test_a_task_knows_nothing_of_the_motion() -> None:
    world = hop_world(3)
    task = world.task
    assert type(task) is Task
    known = {"size", "cost", "t_max", "safe_cost", "reward", "max_steps", "window", "markov"}
    known |= {
        "detection",
        "safe_detection",
        "coverage",
        "memory",
        "budget",
        "clip",
        "revealed",
        "place",
    }
    assert {field.name for field in dataclasses.fields(task)} == known
    assert not any(np.shape(value) == (4, 4) for value in vars(task).values())
    assert (task.num_cells, task.num_choices) == (4, 4)


def test_a_task_has_the_defaults_of_make_world() -> None:
    world = World(np.eye(4) * 0.9, 2, cost=0.1)
    assert (world.t_max, world.reward, world.max_steps) == (1, 1.0, None)


def test_derived_tables() -> None:
    world = hop_world()
    assert world.stay_probability.tolist() == [0.75] * 4


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(
        UserError, match=r"cost: 3 values, expected one number or 4 \(one per cell\)"
    ):
        Task(2, cost=np.zeros(3), safe_cost=1.0, t_max=0)
    for cost in ("prices.csv", np.full(4, 0.1 + 1j)):
        with pytest.raises(UserError, match=r"cost: .*, expected numbers"):
            Task(2, cost=cost)
    for size in (2.0, None):
        with pytest.raises(UserError, match=f"size={size}: expected an integer >= 1"):
            Task(size, cost=0.1)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"kernel: 9 rows, but a 2x2 grid has 4 cells"):
        World(np.eye(9), 2, cost=np.zeros(4), safe_cost=1.0, t_max=0)


@pytest.mark.parametrize(("name", "most"), [("window", "1,024"), ("t_max", "10,000")])
def test_a_history_of_actions_that_fits_nowhere_is_refused(name: str, most: str) -> None:
    with pytest.raises(UserError, match=f"{name}=1000000000: expected an integer from 0 to {most}"):
        Task(2, cost=0.1, **{"t_max": 0, name: 10**9})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "made",
    [
        lambda: make_world("random_walk", size=10**9),
        lambda: make_world("heading", size=[3, 10**18]),
        lambda: World(np.eye(9) / 2, 10**9, cost=0.1, t_max=1),
        lambda: load_tracks("no such file.csv", 10**9),
    ],
)
def test_a_grid_that_cannot_fit_into_memory_is_refused_before_any_is_asked_for(
    made: Callable[[], Any],
) -> None:
    with pytest.raises(UserError, match=r"size=\[?\d.*: needs about .* GiB") as said:
        made()
    assert "\n" not in str(said.value)


def test_expected_steps_of_a_group_are_those_of_the_longest_of_geometric_episodes() -> None:
    stay = 0.995
    group = Group([World(np.full((2, 2), stay / 2), (1, 2), cost=0.1)] * 3)
    longest = 3 / (1 - stay) - 3 / (1 - stay**2) + 1 / (1 - stay**3)
    assert group.expected_steps == pytest.approx(longest, rel=1e-11)
    assert group.target_steps == pytest.approx(3 * stay / (1 - stay), rel=1e-11)
