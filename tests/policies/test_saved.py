"""`policy.npz`: a policy as bytes that depend on nothing else, and what is no policy is refused."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse

import trackmdp as tm
from tests.helpers import small_world, train_config
from trackmdp.app.commands import train
from trackmdp.errors import UserError
from trackmdp.grid.place import Place
from trackmdp.policies import saved
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.policies.saved import load_policy, save_policy
from trackmdp.sensing.task import Task
from trackmdp.solvers import rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.problem_file import read_problem


def stored(**changed: Any) -> bytes:
    """A `policy.npz` of a 2x2 grid, t_max 0, all sensors on, with other arrays."""
    arrays: dict[str, Any] = {
        "task_size": np.array([2, 2]),
        "task_cost": np.full(4, 0.1),
        "task_t_max": np.array(0),
        "task_safe_cost": np.array(0.4),
        "task_reward": np.array(1.0),
        "task_markov": np.array(True),
        "indices": np.tile(np.arange(4, dtype=np.int32), 4),
        "indptr": np.arange(0, 20, 4),
        "value": np.zeros(4),
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **(arrays | changed))
    return stream.getvalue()


def test_a_policy_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    world = small_world(3, t_max=2)
    policy = as_policy(world, rules.qmdp(world))
    value = evaluate(world, policy).value
    policy.save(tmp_path / "policy.npz", value)
    found, values = load_policy(tmp_path / "policy.npz")
    assert values is not None
    assert np.array_equal(values, value)
    assert np.array_equal(found.dense(), policy.dense())
    assert 0 < found.dense().mean() < 1
    assert found.task.size == (3, 3)
    assert (found.task.t_max, found.task.max_steps, found.task.safe_cost) == (
        2,
        None,
        world.safe_cost,
    )
    assert np.array_equal(found.task.cost, world.cost)


def test_limits_and_probabilities_are_kept(tmp_path: Path) -> None:
    task = Task((2, 3), cost=0.5, t_max=1, max_steps=7, window=2, markov=False)
    half = Policy(task, sparse.csr_array(np.full((12, 6), 0.5)))
    for policy in (half, Policy.none(task), Policy(task, probability=0.25)):
        policy.save(tmp_path / "policy.npz")
        found = Policy.load(tmp_path / "policy.npz")
        assert (found.task.max_steps, found.task.window, found.task.markov) == (7, 2, False)
        assert (found.deterministic, found.alike) == (policy.deterministic, policy.alike)
        assert found.chosen(1, np.arange(6), np.arange(6)) == pytest.approx(
            policy.chosen(1, np.arange(6), np.arange(6))
        )
    # Also without one of the sensors a single number stands for all sets: written out, they would be M² (t_max + 1).
    Policy.all_on(Task(2, cost=[np.nan, 0.1, 0.1, 0.1])).save(tmp_path / "policy.npz")
    assert Policy.load(tmp_path / "policy.npz").alike


def test_the_place_of_the_grid_is_kept(tmp_path: Path) -> None:
    for place in (Place((1.5, -2.0), 50.0, "EPSG:32632"), Place((0, 0), 1, downwards=True), None):
        Policy.all_on(Task(2, cost=0.1, t_max=0, place=place)).save(tmp_path / "policy.npz")
        assert Policy.load(tmp_path / "policy.npz").task.place == place
    (tmp_path / "other.npz").write_bytes(
        stored(**{"task_place.cell": np.array(-1.0), "task_place.corner": np.ones(2)})
    )
    with pytest.raises(UserError, match=r"^.*other\.npz: .*place: corner .*, cell -1"):
        Policy.load(tmp_path / "other.npz")


@pytest.mark.parametrize("window", [None, 1])
def test_exactly_k_sensors_come_back_as_exactly_k(window: int | None, tmp_path: Path) -> None:
    task = Task(4, cost=0.16, t_max=1, window=window)
    policy, file = Policy.random_k(task, 3), tmp_path / "policy.npz"
    policy.save(file)
    found = Policy.load(file)
    at = torch.tensor([5, 5, 10]), torch.tensor([0, 1, 0])  # inner cells, whose windows are whole
    draws = torch.rand(3, 16, generator=torch.Generator().manual_seed(0))
    assert found.act(*at, draws).sum(-1).tolist() == [3, 3, 3]
    assert torch.equal(found.act(*at, draws), policy.act(*at, draws))


def test_a_run_leaves_the_policy_of_its_summary(tmp_path: Path) -> None:
    cfg = train_config(
        "grid.size=3",
        "algo.total_frames=2048",
        "algo.frames_per_batch=1024",
        "algo.envs=64",
        "algo=hindsight",
        "algo.updates=5",
    )
    cfg.quiet, cfg.optimal.enabled = True, False
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        aihtr = train.run(cfg, tmp_path / name)
    world = read_problem(tmp_path / "a/problem.npz")
    found, value = load_policy(tmp_path / "a/policy.npz")
    assert value is not None
    assert evaluate(world, found).aihtr == aihtr
    assert value.mean() == pytest.approx(aihtr, rel=1e-12)
    assert (tmp_path / "a/policy.npz").read_bytes() == (tmp_path / "b/policy.npz").read_bytes()


def test_the_file_made_here_is_a_policy(tmp_path: Path) -> None:
    (tmp_path / "policy.npz").write_bytes(stored())
    found, _ = load_policy(tmp_path / "policy.npz")
    assert found.dense().all()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x03\x04 and then nothing",
        stored()[:100],
        stored(task_size=np.array([4, 1, 5])),
        stored(task_size=np.array([4, 4])),
        stored(indices=np.tile(np.arange(1, 5, dtype=np.int32), 4)),
        stored(indices=np.tile(np.arange(4.0), 4)),
        stored(indices=np.tile(np.array([0, 1, 1, 2], dtype=np.int32), 4)),
        stored(indptr=np.array([0, 99, 8, 12, 16])),
        stored(indptr=np.array([-4, 4, 8, 12, 16])),
        stored(value=np.zeros(3)),
        stored(value=np.array(["a", "b", "c", "d"])),
        stored(data=np.full(16, np.nan)),
        stored(probability=np.array(2.0)),
        stored(k=np.array(5)),
        stored(task_cost=np.full(4, 1j)),
        stored(task_cost=np.array([{}, {}, {}, {}], dtype=object)),
    ],
)
def test_what_is_no_policy_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "policy.npz").write_bytes(content)
    with pytest.raises(UserError) as caught:
        load_policy(tmp_path / "policy.npz")
    assert "\n" not in str(caught.value)


def test_saving_replaces_the_file_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = Policy.all_on(small_world())
    save_policy(tmp_path / "policy.npz", policy)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        save_policy(tmp_path / "policy.npz", Policy.none(small_world()))
    assert Policy.load(tmp_path / "policy.npz").sensors(0, 0)


def test_sets_of_all_sensors_are_not_listed_on_a_grid_of_some_size(tmp_path: Path) -> None:
    large, small = (Policy.all_on(small_world(side, t_max=1)) for side in (40, 5))
    assert (saved.listable(large), saved.listable(small)) == (False, True)
    with pytest.raises(UserError, match="too many sets"):
        tm.export(large, tmp_path / "a.json")


@pytest.mark.parametrize(
    ("limit", "listed"),
    [("CELLS", 9), ("CELLS", 8), ("NUMBERS", 18 + 54), ("NUMBERS", 18 + 53)],
)
def test_sets_are_read_back_from_a_list_and_from_an_array_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, listed: int
) -> None:
    world = small_world(3, t_max=1)  # 9 cells, two sets each
    on = np.zeros((9, 2, 9))
    on[..., :3] = 1  # three sensors in each of 18 sets
    policy, value = Policy.from_dense(world, on), np.arange(9.0)
    monkeypatch.setattr(saved, f"LISTED_{limit}", listed)
    named = saved.write_sets(tmp_path, policy, value=value)
    name = "sets.json" if listed in (9, 18 + 54) else "sets.npz"
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert named["value"] == (value.tolist() if name == "sets.json" else "sets.npz")
    found = saved.read_sets(world, tmp_path / name)
    assert np.array_equal(found.dense(), policy.dense())
    with pytest.raises(UserError, match=r"; expected (\[2, 2\]|2 x 2)"):
        saved.read_sets(small_world(2, t_max=1), tmp_path / name)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            '{"size": [2, 2], "t_max": 0, "sets": {"0": [[4]], "1": [[]], "2": [[]], "3": [[]]}}',
            "not sets",
        ),
        ('{"size": [2, 2], "t_max": 0, "sets": {"0": [[1]]}}', "not sets .1 plans"),
        (
            '{"size": [2, 2], "t_max": 0, "sets": {"0": [["x"]], "1": [[]], "2": [[]], "3": [[]]}}',
            "not sets",
        ),
        (
            '{"size": [1, 4], "t_max": 0, "sets": {"0": [[]], "1": [[]], "2": [[]], "3": [[]]}}',
            "size .1, 4.,.* .2, 2.",
        ),
        ('{"t_max": 0, "sets": {"0": [[]], "1": [[]], "2": [[]], "3": [[]]}}', "not sets .*size"),
        ('{"size": [2, 2], "t_max": 0}', "not sets .no 'sets'"),
        ('{"size": [2, 2], "t_max": 0, "sets": 4}', "not sets .sets: expected 4 plans"),
        *(
            (
                f'{{"size": [2, 2], "t_max": 0, "sets": {{"0": [[]], "1": {plan}, "2": [[]], "3": [[]]}}}}',
                f"not sets .plan 1: {said}",
            )
            for plan, said in (
                ("[[0, 1.5]]", "sensor 1.5, expected a whole number from 0 to 3"),
                ("[[true]]", "sensor True, expected"),
                ("[[-1]]", "sensor -1, expected"),
                ("[[], []]", "expected 1 lists of sensors"),
                ("[null]", "expected 1 lists of sensors"),
                ("[{}]", "expected 1 lists of sensors"),
                ('[""]', "expected 1 lists of sensors"),
                ("null", "expected 1 lists of sensors"),
            )
        ),
        *(
            (f'{{"memory": {memory}, "size": [2, 2], "t_max": 0, "sets": {{}}}}', said)
            for memory, said in (
                ("5", "not sets .memory 5: expected an object with kind and clip"),
                ("[]", "not sets .memory"),
                ('{"kind": ["cell"], "clip": 2}', "not sets .memory"),
                ('{"kind": "cell"}', "not sets .no 'clip'"),
            )
        ),
        ("[]", "expected a JSON object"),
    ],
)
def test_a_file_of_no_sets_is_refused_in_one_line(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "sets.json").write_text(content, encoding="utf-8")
    with pytest.raises(UserError, match=said) as caught:
        saved.read_sets(small_world(2, t_max=0), tmp_path / "sets.json")
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="expected a sets"):
        saved.read_sets(small_world(2, t_max=0), tmp_path / "sets.txt")
