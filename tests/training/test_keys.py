"""Learning what to do for each key: where a detection tells the mode, and where a policy remembers a displacement."""

from __future__ import annotations

from typing import Any

import pytest

import trackmdp as tm
from tests.helpers import headings, later

FEW = {"updates": 4, "updates_per_iteration": 4, "batch_size": 256, "hidden": 8}
"""Of what learns after collecting."""
SHORT = {"collector.envs": 64, "collector.frames_per_batch": 512, "optimal.enabled": False}
KNOWN: dict[str, dict[str, Any]] = {
    "told": {"revealed": 8},
    "remembered": {"memory": "displacement"},
}


@pytest.mark.parametrize(
    ("algo", "known"),
    [
        ("a2c", "told"),
        ("dqn", "remembered"),
        ("hindsight", "told"),
        *later([("hindsight", "remembered"), ("a2c", "remembered"), ("dqn", "told")]),
    ],
)
def test_a_run_learns_a_plan_for_each_key(algo: str, known: str) -> None:
    world, more = headings(**KNOWN[known]), FEW if algo == "hindsight" else {}
    run, again = (
        tm.train(world, algo, **SHORT, **more, **{"collector.total_frames": 1024}) for _ in range(2)
    )
    assert run.policy.task.keys == world.keys
    assert run.policy.dense().shape == (world.num_keys, 2, 9)
    assert (run.policy.dense() == again.policy.dense()).all()
    played = tm.simulate(world, run.policy, 2000, seed=1).figures()
    assert abs(played.aihtr.mean - run.evaluation.aihtr) < 3 * played.aihtr.standard_error


@pytest.mark.parametrize("sensing", ["all", "chosen"])
def test_the_kernel_of_told_modes_is_learned(sensing: str) -> None:
    """Of 9 cells and 8 headings; chosen sets leave moves between modes to be inferred from misses."""
    world = headings(revealed=8)
    more: dict[str, Any] = {"warm_up": 8000} if sensing == "chosen" else {}
    more |= {
        "collector.total_frames": 20_000,
        "collector.frames_per_batch": 4000,
        "collector.envs": 100,
    }
    run = tm.train(world, "model_based", sensing=sensing, **more)
    best = tm.solve(world)
    assert (best.lower - run.evaluation.aihtr) / run.evaluation.expected_length < 0.006


@pytest.mark.parametrize("known", later(KNOWN))
def test_hindsight_ends_near_what_is_solved(known: str) -> None:
    world = headings(4, 0.9, cost=0.16, **KNOWN[known])
    run = tm.train(world, "hindsight", updates=300, **{"collector.total_frames": 100_000})
    best = tm.solve(world)
    assert (best.lower - run.evaluation.aihtr) / run.evaluation.expected_length < 0.01


@pytest.mark.slow
def test_a_told_heading_is_worth_something_to_a_learner() -> None:
    """A2C ends above the best policy that knows the cell alone."""
    learned = tm.train(
        headings(4, 0.9, cost=0.16, revealed=8), "a2c", **{"collector.total_frames": 200_000}
    )
    assert learned.evaluation.aihtr > tm.solve(headings(4, 0.9, cost=0.16)).lower
