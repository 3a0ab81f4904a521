"""What a task and a world hold."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.helpers import hop_world
from trackmdp.errors import UserError
from trackmdp.world.model import Task, World


def test_a_task_knows_nothing_of_the_motion() -> None:
    world = hop_world(3)
    task = world.task
    assert type(task) is Task
    known = {"size", "reward", "cost", "safe_cost", "t_max", "markov", "homogeneous"}
    assert {field.name for field in dataclasses.fields(task)} == known
    assert not any(np.shape(value) == (4, 4) for value in vars(task).values())
    assert (task.num_cells, task.num_choices) == (4, 4)


def test_derived_tables() -> None:
    world = hop_world()
    assert np.array_equal(world.transition.toarray(), world.kernel)
    assert world.stay_probability.tolist() == [0.75] * 4


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"cost.sensor: expected one number or 4 \(one per cell\), got shape \(3,\)"):
        Task(2, 1.0, np.zeros(3), 1.0, 0)
    with pytest.raises(UserError, match=r"kernel: expected a 4x4 table for a 2x2 grid, got \(9, 9\)"):
        World(2, 1.0, np.zeros(4), 1.0, 0, np.eye(9))
