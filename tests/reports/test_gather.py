"""From a sweep's folder to its results and back; what is wrong in there is named, and the rest is used."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from tests.reports.sweeps import VERSIONS, write_curve, write_run, write_sweep
from trackmdp.durable import write_json
from trackmdp.errors import UserError
from trackmdp.policies.saved import save_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.reports import finished, results
from trackmdp.reports.finished import MOST_POINTS
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.results import Results
from trackmdp.solvers import bounds, qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.folders import read_summary, write_summary
from trackmdp.training.lock import locked
from trackmdp.world.make import build_world
from trackmdp.world.model import Array, Task


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("sweep"))


@pytest.fixture
def sweep(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "sweep"))


def problems(found: Results) -> dict[str, str]:
    return {anomaly.run: anomaly.text for anomaly in found.anomalies}


def plan(folder: Path, *names: str) -> None:
    jobs = [{"folder": name, "overrides": []} for name in names]
    write_json(
        folder / "sweep.json", {"command": "train", "line": "trackmdp train -m hydra.sweep.dir=/x", "jobs": jobs}
    )


def test_every_figure_of_a_run_is_read(whole: Path) -> None:
    found = gather_runs(whole)
    assert len(found.runs) == 12
    assert not found.anomalies
    run = next(run for run in found.runs if run.name == "a2c-0.22-1")
    summary = json.loads((whole / run.name / "summary.json").read_text())
    assert (run.algo, run.seed, run.settings["cost.sensor"]) == ("a2c", 1, 0.22)
    assert run.figure("aihtr") == summary["policy"]["aihtr"]
    assert run.figure("qmdp_accuracy") == summary["qmdp"]["accuracy"]
    assert run.figure("bound_paper") == summary["bounds"]["paper"]
    assert run.figure("optimal_upper") == summary["optimal"]["upper"]
    assert run.config_sha256 == summary["config_sha256"]
    assert found.manifest["wall_seconds"] == 24.0
    assert found.manifest["versions"] == [{"runs": 12, **VERSIONS}]


def test_one_policy_per_group_is_kept_that_of_the_run_in_the_middle(whole: Path) -> None:
    found = gather_runs(whole)
    assert len(found.policies) == 4
    for name, kept in found.policies.items():
        group = [run for run in found.runs if run.name.rsplit("-", 1)[0] == name.rsplit("-", 1)[0]]
        assert kept.value.mean() == pytest.approx(np.median([run.figure("aihtr") for run in group]))
        assert not (kept.sets != finished.read_sensed(whole / name / "policy.npz", (3, 3), 1, _alike).sets).nnz


def _alike(table: PolicyTable) -> Array:
    return np.ones(table.task.num_keys)


def test_plans_of_one_cell_are_averaged_by_how_often_each_occurs(tmp_path: Path) -> None:
    """Two cells and ten classes: after one miss, cell 1 is sensed from cell 0 where the class is 3 or 7."""
    task = Task((1, 2), cost=0.1, t_max=1, safe_cost=1.0, memory="displacement", clip=1)
    sets, visits = np.zeros((2, 10, 2, 2), dtype=bool), np.ones((2, 10))
    sets[0, [3, 7], 1, 1] = True
    visits[0, 7], visits[1] = 3.0, 5.0
    table = PolicyTable(task, sparse.csr_array(sets.reshape(40, 2)))
    save_policy(tmp_path / "policy.npz", table, np.zeros(2))
    found = finished.read_sensed(tmp_path / "policy.npz", (1, 2), 1, lambda _: visits.ravel())
    for read in (found, results.unpack_policies(results.pack_policies({"a": found}))["a"]):
        assert read.choices == 2
        assert read.averaged
        assert read.on(0).nnz == 0
        assert read.on(1).toarray() == pytest.approx(np.array([[0.0, 4 / 12], [0.0, 0.0]]))


def test_a_policy_of_another_grid_is_refused_before_its_visits_are_counted(tmp_path: Path) -> None:
    task = Task((1, 4), cost=0.1, t_max=1, safe_cost=1.0, memory="displacement", clip=1)
    save_policy(tmp_path / "policy.npz", PolicyTable.all_on(task), np.zeros(4))

    def visits(table: PolicyTable) -> Array:
        raise AssertionError(f"visits of {table.task.num_keys} keys")

    for size, t_max in (((2, 2), 1), ((1, 4), 2), ((1, 4), None)):
        with pytest.raises(UserError, match="of another grid or t_max"):
            finished.read_sensed(tmp_path / "policy.npz", size, t_max, visits)


def test_of_sensors_with_footprints_the_cells_that_they_cover_are_kept(tmp_path: Path) -> None:
    task = Task((1, 3), cost=0.1, t_max=0, safe_cost=1.0, coverage=[[1, 1, 0], [0, 1, 1]])
    save_policy(tmp_path / "policy.npz", PolicyTable.from_dense(task, np.eye(3, 2, dtype=bool)[:, None]), np.zeros(3))
    found = finished.read_sensed(tmp_path / "policy.npz", (1, 3), 0, _alike)
    assert found.on(0).toarray().tolist() == [[True, True, False], [False, True, True], [False, False, False]]


def test_motion_and_references_are_kept_per_world(whole: Path) -> None:
    found = gather_runs(whole)
    assert sorted(found.motions) == ["a2c-0.16-0", "a2c-0.22-0"]
    from trackmdp.config import load_run_config

    world = build_world(load_run_config(whole / "a2c-0.22-0"))
    motion = found.motions["a2c-0.22-0"]
    assert np.array_equal(motion.kernel.toarray(), world.kernel.toarray())
    assert np.array_equal(motion.clocked, bounds.clocked(world))
    assert np.array_equal(motion.qmdp, evaluate(world, qmdp.solve(world)).value)


def test_stored_results_read_back_the_same_and_are_small(whole: Path, tmp_path: Path) -> None:
    found = gather_runs(whole)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    results.save_results(found, tmp_path / "a")
    assert results.is_stored(tmp_path / "a")
    assert not results.is_stored(whole)
    read = results.load_results(tmp_path / "a")
    assert [(r.name, dict(r.settings), dict(r.figures)) for r in read.runs] == [
        (r.name, dict(r.settings), dict(r.figures)) for r in found.runs
    ]
    assert read.curves.keys() == found.curves.keys()
    for name, kept in found.policies.items():
        assert not (read.policies[name].sets != kept.sets).nnz
        assert np.array_equal(read.policies[name].value, kept.value)
    for name, motion in found.motions.items():
        assert np.array_equal(read.motions[name].kernel.toarray(), motion.kernel.toarray())
        assert np.array_equal(read.motions[name].qmdp, motion.qmdp)
        assert np.array_equal(read.motions[name].clocked, motion.clocked)
    results.save_results(read, tmp_path / "b")
    for file in sorted((tmp_path / "a").iterdir()):
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes(), file.name
    assert sum(file.stat().st_size for file in (tmp_path / "a").iterdir()) < 20_000


def test_no_path_of_the_machine_is_kept(sweep: Path, tmp_path: Path) -> None:
    plan(sweep, "a2c-0.16-0")
    (tmp_path / "out").mkdir()
    results.save_results(gather_runs(sweep), tmp_path / "out")
    for file in ("manifest.json", "runs.csv"):
        assert str(tmp_path) not in (tmp_path / "out" / file).read_text()
    assert results.load_results(tmp_path / "out").manifest["line"] == "trackmdp train -m"


def test_a_curve_keeps_its_ends_and_few_points(sweep: Path) -> None:
    values = np.linspace(-5.0, 5.0, 300)
    write_curve(sweep / "a2c-0.16-0", values)
    curve = gather_runs(sweep).curves["a2c-0.16-0"]
    assert len(curve) <= MOST_POINTS
    assert (curve[0].aihtr, curve[-1].aihtr, curve[-1].iteration) == (values[0], values[-1], 600)
    gaps = np.diff([point.iteration for point in curve])
    assert gaps[0] < gaps[-1]


def test_a_run_by_blocks_is_one_run_that_needs_no_curve(tmp_path: Path) -> None:
    write_run(tmp_path / "whole", "partition.block=4")
    (tmp_path / "whole" / "metrics.csv").unlink()
    for number in range(2):
        write_run(tmp_path / "whole" / "blocks" / f"{number:05d}", seed=number)
    for place, name in ((tmp_path, "whole"), (tmp_path / "whole", ".")):  # the folder of the run itself, too
        found = gather_runs(place)
        assert [run.name for run in found.runs] == [name]
        assert found.anomalies == []


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_failure_or_a_plan_that_says_nothing_is_no_obstacle(sweep: Path, text: str) -> None:
    for name in ("a2c-0.16-0/failed.json", "sweep.json"):
        (sweep / name).write_text(text)
    found = gather_runs(sweep)
    assert problems(found)["a2c-0.16-0"] == "failed: no reason given"
    assert found.manifest["planned"] is None


def test_what_is_wrong_with_a_run_is_named(sweep: Path) -> None:
    (sweep / "a2c-0.16-0/summary.json").unlink()
    (sweep / "a2c-0.16-1/summary.json").write_text('{"frames": 3')
    (sweep / "a2c-0.16-2/summary.json").write_text('{"frames": 3}')
    (sweep / "a2c-0.22-0/config.yaml").write_text("a: [")
    write_json(sweep / "a2c-0.22-1/failed.json", {"reason": "out of luck"})
    (sweep / "hindsight-0.16-1/metrics.csv").write_text("iteration,frames\n1,x\n")
    for seed in range(3):
        (sweep / f"hindsight-0.22-{seed}/policy.npz").write_bytes(b"nothing")
    (sweep / "hindsight-0.16-0/kernel.npz").unlink()
    found = gather_runs(sweep)
    said = problems(found)
    assert len(found.runs) == 7
    assert said["a2c-0.16-0"] == "cut: it has no summary.json"
    assert said["a2c-0.16-1"].startswith("summary.json: not JSON")
    assert said["a2c-0.16-2"].startswith("summary.json: its content does not match its digest")
    assert said["a2c-0.22-0"].startswith("config.yaml: not the file that this run left")
    assert said["a2c-0.22-1"] == "failed: out of luck"
    assert said["hindsight-0.16-1"] == "no learning curve"
    assert said["hindsight-0.22-1"].startswith("policy.npz: not the file that this run left")
    assert said["hindsight-0.16-0"].startswith("its world cannot be built")
    assert said["a2c"] == "no run in 1 of 2 worlds: Z=5, c=0.16"
    assert sorted(found.policies)[0] == "a2c-0.22-2"
    assert len(found.policies) == 2


def test_a_run_of_a_version_with_other_options_counts(sweep: Path) -> None:
    file = sweep / "a2c-0.16-0/config.yaml"
    file.write_text(
        file.read_text().replace("  radius: 1\n", "  radius: 1\n  later: 3\n").replace("algo:", "algo:\n  x: 1")
    )
    write_summary(file.parent, read_summary(file.parent))
    found = gather_runs(sweep)
    assert len(found.runs) == 12
    assert "a2c-0.16-0" in found.motions


def test_a_run_under_way_is_not_called_cut(sweep: Path) -> None:
    (sweep / "a2c-0.16-0/summary.json").unlink()
    with locked(sweep / "a2c-0.16-0"):
        assert problems(gather_runs(sweep))["a2c-0.16-0"] == "still running"


def test_a_missing_seed_is_named(sweep: Path) -> None:
    shutil.rmtree(sweep / "a2c-0.16-1")
    assert problems(gather_runs(sweep)) == {"a2c, Z=5, c=0.16": "seed 1 missing"}


def test_what_was_planned_and_is_not_there_is_named(sweep: Path) -> None:
    names = sorted(path.name for path in sweep.iterdir())
    plan(sweep, *names, "ppo-0.16-0")
    found = gather_runs(sweep)
    assert problems(found) == {"ppo-0.16-0": "not started"}
    assert found.manifest["planned"] == 13


def test_runs_of_other_versions_and_repeated_runs_are_named(sweep: Path) -> None:
    shutil.rmtree(sweep / "a2c-0.16-1")
    write_run(sweep / "a2c-0.16-1", "grid.size=3", "algo=a2c", seed=1, versions=VERSIONS | {"torch": "1.0"})
    shutil.copytree(sweep / "a2c-0.22-0", sweep / "z")
    found = gather_runs(sweep)
    assert problems(found) == {
        "a2c-0.16-1": "other versions: torch 1.0, most have 2.13.0",
        "z": "the same config as a2c-0.22-0, which counts",
    }
    assert len(found.runs) == 12


@pytest.mark.parametrize("content", [None, "runs/notes.txt"])
def test_a_folder_without_runs_is_refused(content: str | None, tmp_path: Path) -> None:
    if content:
        (tmp_path / content).parent.mkdir()
        (tmp_path / content).touch()
    with pytest.raises(UserError, match="no runs in there"):
        gather_runs(tmp_path)


@pytest.mark.parametrize(
    ("file", "content"),
    [("runs.csv", "run\nx\n"), ("policies.npz", "PK"), ("worlds.npz", ""), ("curves.csv", "run,iteration\n99,1\n")],
)
def test_damaged_stored_results_are_refused_in_one_line(file: str, content: str, whole: Path, tmp_path: Path) -> None:
    results.save_results(gather_runs(whole), tmp_path)
    (tmp_path / file).write_text(content)
    with pytest.raises(UserError, match="not stored results that can be read") as caught:
        results.load_results(tmp_path)
    assert "\n" not in str(caught.value)
