"""The unit in which rewards and prices are counted changes no learned policy.

A factor that is a power of 2 changes the exponents of floats alone, so that figures agree to the last bit.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

import trackmdp as tm
from tests.helpers import ALGORITHMS, headings, later, small_world

UNITS = (2.0**-40, 2.0**20)
FEW: dict[str, Any] = {"total_frames": 1024, "frames_per_batch": 256, "envs": 32}
CREDIT: dict[str, Any] = FEW | {"updates": 15, "hidden": 16, "batch_size": 256}
OPTIONS: dict[str, dict[str, Any]] = {
    "a2c": FEW,
    "ppo": FEW,
    "dqn": FEW | {"buffer_size": 1024, "batch_size": 64},
    "model_based": FEW,
}


def in_units(world: tm.World, unit: float) -> tm.World:
    paid = {name: getattr(world, name) * unit for name in ("cost", "safe_cost", "reward")}
    return replace(world, **paid)


def check(world: tm.World, name: str, **options: Any) -> None:
    expected, *others = (tm.train(in_units(world, unit), name, **options) for unit in (1.0, *UNITS))
    for run, unit in zip(others, UNITS, strict=True):
        assert (run.policy.sets != expected.policy.sets).nnz == 0
        assert run.evaluation.aihtr == expected.evaluation.aihtr * unit


SLOW = ("ppo", "a2c_per_sensor", "ppo_per_sensor", "dqn_per_sensor")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in ALGORITHMS],
)
def test_of_moves(name: str) -> None:
    check(small_world(), name, **OPTIONS.get(name, CREDIT))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("hindsight", CREDIT),
        *later([("model_based", FEW | {"estimate": "paths", "total_frames": 2048})]),
    ],
)
def test_of_whole_paths(name: str, options: dict[str, Any]) -> None:
    check(headings(memory="displacement", markov=False), name, **options)
