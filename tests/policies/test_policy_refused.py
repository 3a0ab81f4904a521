"""What is no policy, what draws without saying so, and states that are none, refused in one line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor

from tests.helpers import small_world
from tests.policies.test_policy import CHOICES, WORLD, M, table
from trackmdp.environment.env import TrackEnv
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluate import evaluate


class Signs(torch.distributions.HalfNormal):
    """Draws subsets, and does not say how likely each is."""

    has_rsample = False

    def sample(self, sample_shape: Any = ()) -> torch.Tensor:
        return super().sample(sample_shape) > 1


SHARED = torch.Generator().manual_seed(0)

DRAWING: dict[str, Any] = {
    "torch": lambda x, n, h: torch.rand(len(x), M) < 0.5,
    "torch, seldom": lambda x, n, h: torch.rand(len(x), M) < 1e-9,
    "its own generator": lambda x, n, h: torch.rand(len(x), M, generator=SHARED) < 0.5,
    "numpy": lambda x, n, h: np.random.random((len(x), M)) < 0.5,  # noqa: NPY002
    "module": TensorDictModule(
        lambda x: torch.rand(*x.shape, M) < 0.5, in_keys=["last_cell"], out_keys=["action"]
    ),
    "an actor of another form": ProbabilisticActor(
        TensorDictModule(
            lambda x: torch.ones(len(x), M), in_keys=["last_cell"], out_keys=["scale"]
        ),
        in_keys=["scale"],
        distribution_class=Signs,
    ),
    "dropout": TensorDictModule(
        lambda x: torch.nn.functional.dropout(torch.ones(*x.shape, M)) > 0,
        in_keys=["last_cell"],
        out_keys=["action"],
    ),
}


@pytest.mark.parametrize("name", DRAWING)
def test_what_draws_is_refused_in_one_line(name: str) -> None:
    with pytest.raises(UserError, match="draws at random") as refused:
        as_policy(WORLD, DRAWING[name])
    assert "\n" not in str(refused.value)


def sequence(key: str) -> TensorDictModule:
    return TensorDictModule(
        lambda x: torch.ones(len(x), M, dtype=torch.bool), in_keys=[key], out_keys=["action"]
    )


WRONG: dict[str, tuple[Any, str]] = {
    "numbers": (
        lambda x, n, h: torch.full((len(x), M), 0.5),
        "its action: expected 0 or 1 for each sensor, got 0.5",
    ),
    "another width": (
        lambda x, n, h: torch.zeros(len(x), M + 1, dtype=torch.bool),
        r"bool \[9, 10\]",
    ),
    "reads more": (sequence("hidden"), "reads hidden"),
    "reads the target": (sequence("target"), "reads target"),
    "no action": (
        TensorDictModule(torch.nn.Identity(), in_keys=["last_cell"], out_keys=["a"]),
        "writes no action",
    ),
    "a number": (3, "a int, expected a Policy"),
    "a class": (Policy, "the class Policy, expected an object of it"),
    "another world": (
        Policy.all_on(small_world(2, t_max=2)),
        "made for 2 x 2 cells, t_max 2; expected 3 x 3",
    ),
    "as many cells": (Policy.all_on(Task((1, 9), cost=0.1, t_max=2)), "made for 1 x 9 cells"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_policy_is_refused_in_one_line(name: str) -> None:
    given, message = WRONG[name]
    with pytest.raises(UserError, match=message):
        as_policy(WORLD, given)


@pytest.mark.parametrize(
    "wrong", [np.zeros((M, CHOICES, M + 1)), np.full((M, CHOICES, M), 1.5), -table().astype(int)]
)
def test_a_table_that_is_none_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(UserError, match="expected"):
        Policy.from_dense(WORLD, wrong)


def test_a_complex_table_is_refused() -> None:
    for make in (lambda on: Policy.from_dense(WORLD, on), lambda on: evaluate(WORLD, on)):
        with pytest.raises(UserError, match="complex128"):
            make(table() * 1j)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("last_cell", -1),
        ("last_cell", M),
        ("steps_since_detection", -1),
        ("steps_since_detection", CHOICES + 1),
    ],
)
@pytest.mark.parametrize(
    "acting",
    [Policy.all_on(WORLD), Policy.from_dense(WORLD, table()), Policy.random_k(WORLD, 2)],
)
def test_a_state_that_is_none_is_refused(acting: Policy, key: str, value: int) -> None:
    rows = {"last_cell": torch.tensor([1, 2]), "steps_since_detection": torch.tensor([0, 1])}
    rows[key][1] = value
    with pytest.raises(UserError, match=f"{key}={value}"):
        acting(TensorDict(rows, [2]))


def test_a_policy_of_keys_is_refused_where_none_are_observed() -> None:
    remembers = Policy.all_on(replace(small_world(), memory="displacement"))
    with pytest.raises(UserError, match=r"reads key.*memory=displacement"):
        TrackEnv(small_world(), 2).rollout(2, policy=remembers)


@pytest.mark.parametrize("k", [1.5, "2", True, -1, M + 1])
def test_a_number_of_sensors_that_is_none_is_refused(k: Any) -> None:
    with pytest.raises(UserError, match=f"^policy: k={k!r}: expected an integer from 0 to {M}"):
        Policy.random_k(WORLD, k)
