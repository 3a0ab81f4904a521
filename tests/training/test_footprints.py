"""Learning with sensors that have footprints, from Python and the command line, resumed and logged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import later, small_world
from trackmdp.errors import UserError
from trackmdp.sensing.coverage import discs
from trackmdp.world.model import World

SHORT = {
    "total_frames": 2048,
    "collector.envs": 64,
    "frames_per_batch": 512,
    "optimal.enabled": False,
}


def _world() -> World:
    places = np.array([(0, 0), (0, 2), (2, 0), (2, 2)])
    return World.of(
        small_world(),
        small_world().kernel,
        coverage=discs((3, 3), places, 1.5),
        cost=[0.1, 0.2, 0.3, 0.4],
    )


@pytest.mark.parametrize("algo", ["a2c", "hindsight", *later(["ppo", "dqn"])])
def test_sets_of_sensors_are_learned_and_kept(algo: str, tmp_path: Path) -> None:
    few = {"updates": 20, "updates_per_iteration": 10, "hidden": 16, "batch_size": 256}
    more = few if algo == "hindsight" else {}
    run = tm.train(_world(), algo, folder=tmp_path / "run", **SHORT, **more)
    assert run.policy.task.total_sensors == 4
    assert tm.evaluate(_world(), run.policy).aihtr == pytest.approx(run.evaluation.aihtr)
    again = tm.load_run(tmp_path / "run")
    assert (again.policy.dense() == run.policy.dense()).all()


@pytest.mark.parametrize("algo", ["a2c", "model_based", *later(["dqn"])])
def test_a_budget_is_kept_to_by_sensors_that_share_cells(algo: str) -> None:
    world = _world().but(budget=1)
    run = tm.train(world, algo, **SHORT)
    assert run.policy.dense().sum(axis=-1).max() == 1
    assert (tm.simulate(world, run.policy, 100, seed=1).sensors <= 1).all()
    if algo == "model_based":
        assert run.evaluation.aihtr == pytest.approx(tm.solve(world).lower, rel=0.05)


@pytest.mark.parametrize("collect", ["all_on", "mixed"])
def test_moves_count_although_a_sensor_is_missing(collect: str) -> None:
    """Where others cover its cells, a step with all others on is fully sensed."""
    places = np.array([(0, 0), (0, 2), (2, 0), (2, 2), (1, 1)])
    world = World.of(
        small_world(),
        small_world().kernel,
        coverage=discs((3, 3), places, 1.5),
        cost=[0.1, 0.2, 0.3, 0.4, np.nan],
    )
    few = {"updates": 4, "updates_per_iteration": 4, "hidden": 16, "batch_size": 256}
    run = tm.train(world, "hindsight", collect=collect, **SHORT, **few)
    assert run.columns["moves"][-1] > 0
    assert not run.policy.dense()[..., 4].any()


LEARNS = {
    "total_frames": 32_768,
    "updates": 300,
    "updates_per_iteration": 100,
    "batch_size": 2048,
    "hidden": 32,
}


@pytest.mark.parametrize(
    ("algo", "t_max"),
    later(
        [
            ("hindsight", 2),
            ("hindsight", 0),
            ("a2c_per_sensor", 2),
            ("ppo_per_sensor", 0),
            ("dqn_per_sensor", 2),
        ]
    ),
)
def test_what_sensors_gain_beside_the_others_leads_to_the_optimum(algo: str, t_max: int) -> None:
    world = World.of(_world(), small_world(exit_probability=0.02).kernel, t_max=t_max)
    # Its nets alone need their own schedule.
    budget = {"total_frames": 32_768} if algo == "hindsight" else LEARNS
    run = tm.train(world, algo, **SHORT | budget)
    best = tm.solve(world)
    assert (best.upper - run.evaluation.aihtr) / run.evaluation.expected_length < 0.01


@pytest.mark.long
def test_sets_that_cool_down_do_not_end_where_no_single_sensor_gains() -> None:
    """Hard sets from the first update on end at a regret of .0097 per step here."""
    plain = tm.make_world("random_support", size=8, cost=0.16)
    world = World.of(plain, plain.kernel, coverage=discs((8, 8), np.argwhere(np.ones((8, 8))), 2.0))
    run = tm.train(world, "dqn_per_sensor")
    best = tm.solve(world)
    assert (best.upper - run.evaluation.aihtr) / run.evaluation.expected_length < 0.002


@pytest.mark.parametrize(
    ("algo", "options"),
    later(
        [
            ("hindsight", {}),
            ("model_based", {"sensing": "all"}),
            ("model_based", {"sensing": "chosen"}),
            ("a2c_per_sensor", {}),
        ]
    ),
)
def test_moves_to_cells_that_none_covers_are_inferred(algo: str, options: dict[str, str]) -> None:
    """Two cells are covered by no sensor: moves to them are told by what is missed, and by the safe action."""
    kernel = np.full((9, 9), 0.02)
    kernel[np.arange(9), (np.arange(9) + 1) % 9] = 0.78
    coverage = discs((3, 3), np.array([(0, 0), (0, 2), (2, 0)]), 1)
    world = World(kernel, 3, cost=0.2, t_max=1, safe_cost=1.0, coverage=coverage)
    assert world.coverage is not None
    assert (np.diff(world.coverage.by_cell.indptr) == 0).sum() == 2
    run = tm.train(world, algo, total_frames=20_480, **{"optimal.enabled": False}, **options)
    best = tm.solve(world)
    regret = (best.lower - run.evaluation.aihtr) / run.evaluation.expected_length
    assert regret < 0.004


def test_a_run_of_other_footprints_is_not_resumed(tmp_path: Path) -> None:
    tm.train(_world(), "a2c", folder=tmp_path, **SHORT)
    other = World.of(_world(), _world().kernel, coverage=np.ones((4, 9)))
    with pytest.raises(UserError, match="belongs to a run with another config or problem"):
        tm.train(other, "a2c", folder=tmp_path, resume="auto", **SHORT)
