"""Sensors with footprints in the world: what they cover, the environment by hand, files, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse

import trackmdp as tm
from tests.helpers import advanced, small_world
from trackmdp import machine
from trackmdp.app.cli import main
from trackmdp.config.sensors import lattice
from trackmdp.environment.dynamics import Dynamics
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.paths import path_sampler
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import load_policy, read_sets, save_policy, write_sets
from trackmdp.sensing.coverage import Coverage, discs
from trackmdp.sensing.makers import footprint
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import World

LINE = np.diag(np.full(3, 0.9), 1)
COVERAGE = np.array([[1, 1, 1, 0], [0, 0, 1, 0]])


def _line(**more: object) -> World:
    """Cells 0 1 2 3 in a row, the target going right; sensors of 0 1 2 and of 2 alone, none of 3."""
    given = {"cost": [0.5, 0.25], "t_max": 1, "safe_cost": 2.0, "coverage": COVERAGE} | more
    return World(LINE, (1, 4), **given)  # type: ignore[arg-type]


def _wide() -> World:
    """Four overlapping discs of five cells, and prices of their own, on a grid of 3 x 3."""
    places = np.array([(0, 0), (0, 2), (2, 0), (2, 2)])
    return World.of(
        small_world(),
        small_world().kernel,
        coverage=discs((3, 3), places, 1),
        cost=[0.1, 0.2, 0.3, 0.4],
    )


def test_discs_on_a_lattice() -> None:
    assert list(lattice(10, 3)) == [0, 3, 6, 9]
    assert list(lattice(9, 3)) == [1, 4, 7]
    certain: dict[str, Any] = {"path": None, "p_d": 1.0, "p_s": 1.0}
    found = footprint(9, radius=2.0, spacing=2, **certain)["coverage"]
    assert found.num_sensors == 25
    # In the middle a disc of 13 cells; in the corner 6 of them are left.
    sizes = np.diff(found.matrix.indptr).reshape(5, 5)
    assert (sizes[2, 2], sizes[0, 0]) == (13, 6)
    assert footprint(4, radius=0.0, spacing=1, **certain)["coverage"] is None
    assert footprint((4, 5), radius=1e308, spacing=2, **certain)["coverage"].matrix.nnz == 6 * 20


def test_discs_that_do_not_fit_into_memory_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """500 x 500 sensors, each with a disc of 785,349 places, most of them outside of the grid."""
    monkeypatch.setattr(machine, "free_bytes", lambda: 2**36)
    with pytest.raises(UserError, match=r"^sensor\.radius=500\.0: needs about 5,4"):
        footprint(500, radius=500.0, spacing=1, path=None, p_d=1.0, p_s=1.0)


def test_steps_by_hand() -> None:
    env = TrackEnv(_line(), 3)
    assert env.action_spec.shape == (3, 2)
    start = torch.tensor([0, 1, 2])  # the target moves on to 1, 2 and 3
    state = Dynamics(_line(), path_sampler(_line())).start(start)
    action = torch.tensor([[True, False], [False, True], [True, True]])
    after = advanced(_line(), state | {"action": action}, [0.5] * 3)
    assert after["reward"].squeeze(-1).tolist() == [0.5, 0.75, -0.75]
    assert after["last_cell"].tolist() == [1, 2, 2]  # a detection tells the cell; 3 is seen by none
    assert after["steps_since_detection"].tolist() == [0, 0, 1]
    assert after["action_history"][2, 0].tolist() == [True, True]
    gone = advanced(_line(), state | {"action": action}, [0.99] * 3)
    assert gone["terminated"].all()
    assert (gone["reward"] == 0).all()


def test_the_environment_and_simulation_earn_the_exact_value() -> None:
    world, rng = _wide(), np.random.default_rng(3)
    assert world.safe_cost == small_world().safe_cost
    for policy in (
        Policy.from_dense(world, rng.random((9, 2, 4)) < 0.4),
        Policy.from_dense(world, rng.random((9, 2, 4))),
        Policy.random_k(world, 2),
        Policy.all_on(world),
    ):
        exact, found = evaluate(world, policy), simulate(world, policy, 1500, seed=4).figures()
        assert abs(found.aihtr.mean - exact.aihtr) <= 3 * found.aihtr.standard_error
        assert found.sensors_per_step.mean == pytest.approx(exact.sensors_per_step, abs=0.05)
    env, policy = TrackEnv(world, 3000, seed=1), Policy.random_k(world, 2)
    policy.generator = torch.Generator().manual_seed(2)
    steps = env.rollout(60, policy, break_when_any_done=False)
    located = (steps["next", "steps_since_detection"] == 0) & ~steps["next", "terminated"].squeeze(
        -1
    )
    share = located.sum() / (~steps["next", "terminated"]).sum()
    assert share.item() == pytest.approx(evaluate(world, policy).accuracy, abs=0.01)


@pytest.mark.filterwarnings("error")
def test_a_subset_is_empty_where_a_window_has_no_sensor() -> None:
    world = World(LINE, (1, 4), cost=[0.1, 0.1, np.nan, np.nan], t_max=1, window=0)
    assert np.diff(Policy.random_k(world, 1).written.indptr).tolist() == [1, 1, 1, 1, 0, 0, 0, 0]


@pytest.mark.parametrize("k", [0, 2, 3])
def test_subsets_in_a_window_or_among_cells_without_a_sensor_are_valued_exactly(
    k: int,
) -> None:
    wide, matrix = _wide().but(detection=0.8), discs((3, 3), np.array([(1, 1)]), 1).toarray()
    assert wide.coverage is not None
    with_one_less = wide.but(
        coverage=np.vstack([wide.coverage.matrix.toarray(), matrix]), cost=[*wide.cost, np.nan]
    )
    wanted = evaluate(wide, Policy.random_k(wide, k)).aihtr
    for world in (wide.but(window=2), with_one_less):
        assert evaluate(world, Policy.random_k(world, k)).aihtr == pytest.approx(wanted, rel=1e-12)


def test_the_environment_is_that_of_one_cell_each_where_footprints_are() -> None:
    world = small_world()
    turned = World.of(world, world.kernel, coverage=np.eye(9)[::-1], cost=world.cost[::-1])
    plain, other = (TrackEnv(each, 16, seed=5) for each in (world, turned))
    states = plain.reset(), other.reset()
    for step in range(30):
        action = torch.rand(16, 9, generator=torch.Generator().manual_seed(step)) < 0.5
        after = (
            plain.step(states[0].set("action", action))["next"],
            other.step(states[1].set("action", action.flip(1)))["next"],
        )
        for key in ("last_cell", "steps_since_detection", "reward", "done"):
            assert torch.equal(after[0][key], after[1][key])
        states = tuple(
            env.maybe_reset(each) for env, each in zip((plain, other), after, strict=True)
        )


def test_functions_and_modules_act_on_sensors() -> None:
    world = _wide()
    policy = Policy.from_function(
        world, lambda cell, n, history: torch.ones(len(cell), 4, dtype=torch.bool)
    )
    assert policy.dense().all()
    assert evaluate(world, policy).aihtr == pytest.approx(
        evaluate(world, Policy.all_on(world)).aihtr
    )


def test_saved_policies_keep_their_footprints(tmp_path: Path) -> None:
    world = _wide()
    policy = Policy.from_dense(world, np.random.default_rng(1).random((9, 2, 4)) < 0.5)
    save_policy(tmp_path / "policy.npz", policy)
    again = load_policy(tmp_path / "policy.npz")[0]
    assert world.coverage is not None
    assert world.coverage.same_as(again.task.coverage)
    assert (again.dense() == policy.dense()).all()
    write_sets(tmp_path, policy)
    assert (read_sets(world, tmp_path / "sets.json").dense() == policy.dense()).all()
    other = replace(world, coverage=np.ones((4, 9)))
    for file in ("sets.json", "policy.npz"):
        with pytest.raises(UserError, match="other footprints"):
            read_sets(other, tmp_path / file)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (np.ones((2, 3)), "expected a row per sensor, 4 columns"),
        ([[1, 0, 0, 0], [0, 0, 0, 0]], "sensor 1 covers no cell"),
        ([[1.5, 0, 0, 0]], "0 and 1, or probabilities"),
        ([["a"]], "not a table of numbers"),
        (np.ones(4), "expected a table of 0 and 1"),
    ],
)
def test_what_are_no_footprints(given: object, said: str) -> None:
    with pytest.raises(UserError, match=said):
        Coverage.of(given, 4)


@pytest.mark.parametrize("cost", [[0.1] * 4, [0.1, -1.0]])
def test_prices_are_one_per_sensor(cost: list[float]) -> None:
    with pytest.raises(UserError, match="cost"):
        _line(cost=cost)


@pytest.mark.parametrize(
    ("given", "earned"),
    [
        ({"window": 1}, 0.75),
        ({"memory": "displacement"}, 0.75),
        ({"detection": 0.5}, 0.25),
        ({"coverage": COVERAGE / 2}, 0.25),
        ({"cost": [0.5, np.nan]}, 0.5),
    ],
)
def test_footprints_with_other_features_by_hand(given: dict[str, object], earned: float) -> None:
    """From cell 1 to 2 with .9, then sensor 1 where there is one, else sensor 0: .9 (p_d - c), and from 2 it exits."""
    world = _line(**({"safe_cost": 0.0, "t_max": 0} | given))
    on = np.zeros((world.num_keys, 1, 2), dtype=bool)
    on[world.keys.cell(np.arange(world.num_keys)) == 1, 0, 1 if world.available[1] else 0] = True
    truncated = world.but(max_steps=1)
    assert evaluate(truncated, Policy.from_dense(world, on)).value[1] == pytest.approx(0.9 * earned)


def test_a_table_of_footprints_is_an_argument(tmp_path: Path) -> None:
    """Of `make_world` and `load_tracks`, in memory or in a file, in place of the cells' own sensors."""
    wide, file = _wide(), tmp_path / "a.npz"
    assert wide.coverage is not None
    sparse.save_npz(file, wide.coverage.matrix)
    (tmp_path / "t.csv").write_text("track,cell\n" + "".join(f"{i},4\n{i},5\n" for i in range(9)))
    given = {"size": 3, "cost": [0.1, 0.2, 0.3, 0.4], "detection": 0.9, "safe_cost": 2.0}
    for table in (wide.coverage.matrix, wide.coverage.matrix.toarray(), str(file)):
        for made in (
            tm.make_world("random_walk", coverage=table, **given),
            tm.load_tracks(tmp_path / "t.csv", min_length=2, coverage=table, **given),
            tm.make_world("drift", coverage=table, targets=2, **given).single,
        ):
            assert made.footprints == wide.footprints
            assert (made.cost == wide.cost).all()
            assert (made.detection == 0.9).all()
            assert made.safe_cost == 2.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"coverage": np.ones((2, 8))}, "coverage: a table of 2 x 8, expected a row per sensor, 9"),
        ({"coverage": np.ones((2, 9)), "cost": [0.1]}, "cost.sensor: 1 values, expected one"),
        ({"coverage": "none.npz"}, "none.npz: no such file"),
        ({"sensor": "footprint"}, "sensor: unknown argument, expected coverage, detection"),
    ],
)
def test_footprints_that_do_not_fit_are_named(given: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        tm.make_world("random_walk", size=3, **given)
    assert message in str(caught.value)


def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sparse.save_npz(tmp_path / "a.npz", sparse.csr_array(COVERAGE.astype(float)))
    np.save(tmp_path / "narrow.npy", np.ones((2, 5)))
    words = [
        "sensor=footprint",
        "grid.size=[3,4]",
        "quiet=true",
        f"hydra.run.dir={tmp_path / 'run'}",
    ]
    np.save(tmp_path / "b.npy", np.kron(np.eye(3), np.ones(4)))
    there = [
        *words,
        "baseline=clocked",
        f"sensor.path={tmp_path / 'b.npy'}",
        "cost.sensor=[.1,.2,.3]",
        "episodes=10",
    ]
    for more in (["cost.budget=1"], ["grid.window=1"], ["sensor.p_d=.8", "sensor.p_s=.9"]):
        assert main(["evaluate", *there, *more]) == 0
    refused = {
        "cost.sensor: 2 values, expected one number or 4": [
            "baseline=clocked",
            "cost.sensor=[.1,.2]",
        ],
        "expected one number or 3 (one per sensor)": [*there[4:], "cost.sensor=[.1,.2]"],
        "5, expected a row per sensor, 12 columns": [
            "baseline=none",
            f"sensor.path={tmp_path / 'narrow.npy'}",
        ],
        "no such file": ["baseline=none", f"sensor.path={tmp_path / 'none.npz'}"],
        "sensor.radius=3: without effect": [
            "baseline=none",
            f"sensor.path={tmp_path / 'a.npz'}",
            "sensor.radius=3",
        ],
        "baseline.k=9: expected at most 4": ["baseline=random_k", "baseline.k=9"],
    }
    for said, wrong in refused.items():
        assert main(["evaluate", *words[:3], f"hydra.run.dir={tmp_path / 'wrong'}", *wrong]) != 0
        shown = capsys.readouterr().err
        assert said in shown
        assert shown.count("\n") == 1
    for command, wrong in {
        "solve": ["verify=true"],
        "verify": [],
    }.items():
        assert main([command, *words[:3], *wrong]) != 0
    assert not (tmp_path / "wrong").exists()
