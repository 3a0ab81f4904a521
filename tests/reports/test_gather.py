"""From the folder of a sweep to its results and back; faults are listed, and the other runs are used."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from tests.reports.sweeps import VERSIONS, plan, write_curve, write_run
from trackmdp.config import load_run_config
from trackmdp.durable import write_json, write_sealed
from trackmdp.errors import UserError
from trackmdp.policies.saved import load_policy, save_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.reports import watch
from trackmdp.reports.figures import panels
from trackmdp.reports.finished import MOST_POINTS, averaged_sets
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.grouping import study
from trackmdp.reports.page import build
from trackmdp.reports.results import Results, load_results, save_results
from trackmdp.sensing.task import Task
from trackmdp.solvers import bounds, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.display import make_console
from trackmdp.training.folders import read_summary, run_of, write_summary
from trackmdp.training.lock import locked
from trackmdp.training.run import load_run
from trackmdp.world.configured import build_world

Change = Callable[[Path], Any]


def reasons(found: Results) -> dict[str, str]:
    return {anomaly.run: anomaly.text for anomaly in found.anomalies}


def sealed_again(run: Path) -> None:
    """A summary that fits the files of the run as they are now."""
    plain = {key: value for key, value in read_summary(run).items() if key != "files"}
    write_summary(run, plain)


def test_every_figure_of_a_run_is_read(whole: Path) -> None:
    found = gather_runs(whole)
    assert len(found.runs) == 12
    assert not found.anomalies
    run = next(run for run in found.runs if run.name == "a2c-0.22-1")
    summary = json.loads((whole / run.name / "summary.json").read_text())
    assert (run.algo, run.seed, run.settings["cost.sensor"]) == ("a2c", 1, 0.22)
    assert run.figure("aihtr") == summary["policy"]["aihtr"]
    assert run.references["Q_MDP"]["accuracy"] == summary["qmdp"]["accuracy"]
    assert run.references["all on"]["sensors_per_step"] == pytest.approx(9.0)
    assert run.references["printed bound"]["aihtr"] == summary["bounds"]["paper"]
    assert run.figure("optimal_upper") == summary["optimal"]["upper"]
    assert found.manifest["wall_seconds"] == 24.0
    assert found.manifest["versions"] == [{"runs": 12, **VERSIONS}]


def test_the_policy_that_is_drawn_is_the_middle_one_of_its_seeds(whole: Path) -> None:
    found = gather_runs(whole)
    assert [(each.world, each.method) for each in found.maps] == [
        (world, method)
        for world in ("Z=5, c=0.16", "Z=5, c=0.22")
        for method in ("a2c", "hindsight")
    ]
    for each in found.maps:
        price = each.world[-4:]
        group = [run for run in found.runs if run.name.startswith(f"{each.method}-{price}")]
        assert each.value.mean() == pytest.approx(np.median([run.figure("aihtr") for run in group]))
    world = build_world(load_run_config(whole / "a2c-0.22-0"))
    last = found.maps[-1]
    assert np.array_equal(last.kernel.toarray(), world.kernel.toarray())
    assert np.array_equal(last.bound, bounds.clocked(world))
    assert np.array_equal(last.qmdp, evaluate(world, rules.qmdp(world)).value)


def test_the_best_methods_are_drawn(sweep: Path) -> None:
    """a2c has nine wrong sensors and more, hindsight one to three, ppo none."""
    write_run(sweep / "ppo-0.16-0", "grid.size=3", "algo=ppo", cost=0.16)
    drawn = [(each.world[-4:], each.method) for each in gather_runs(sweep).maps]
    assert drawn == [("0.16", "hindsight"), ("0.16", "ppo"), ("0.22", "a2c"), ("0.22", "hindsight")]


def test_plans_of_one_cell_are_averaged_by_their_visits() -> None:
    """Two cells and ten classes: after one miss, cell 1 is sensed from cell 0 where the class is 3 or 7."""
    task = Task((1, 2), cost=0.1, t_max=1, safe_cost=1.0, memory="displacement", clip=1)
    sets, visits = np.zeros((2, 10, 2, 2), dtype=bool), np.ones((2, 10))
    sets[0, [3, 7], 1, 1] = True
    visits[0, 7], visits[1] = 3.0, 5.0
    table = PolicyTable(task, sparse.csr_array(sets.reshape(40, 2)))
    found = averaged_sets(table, table.seen, visits.ravel())
    assert found[0::2].nnz == 0
    assert found[1::2].toarray() == pytest.approx(np.array([[0.0, 4 / 12], [0.0, 0.0]]))


def test_of_sensors_with_footprints_the_cells_in_view_are_drawn() -> None:
    task = Task((1, 3), cost=0.1, t_max=0, safe_cost=1.0, coverage=[[1, 1, 0], [0, 1, 1]])
    table = PolicyTable.from_dense(task, np.eye(3, 2, dtype=bool)[:, None])
    assert PolicyTable(task, table.written).seen.toarray().tolist() == [
        [1, 1, 0],
        [0, 1, 1],
        [0, 0, 0],
    ]
    everything = PolicyTable(task, PolicyTable.all_on(task).written).seen
    assert everything.toarray().all() and everything.shape == (3, 3)


def test_a_curve_keeps_its_ends_and_few_points(sweep: Path) -> None:
    values = np.linspace(-5.0, 5.0, 300)
    write_curve(sweep / "a2c-0.16-0", values)
    sealed_again(sweep / "a2c-0.16-0")
    curve = next(run for run in gather_runs(sweep).runs if run.name == "a2c-0.16-0").curve
    assert len(curve) <= MOST_POINTS
    assert (curve[0][2], curve[-1][2], curve[-1][0]) == (values[0], values[-1], 60_000)
    assert curve[1][0] - curve[0][0] < curve[-1][0] - curve[-2][0]


def test_a_run_by_blocks_is_one_run_that_needs_no_curve(tmp_path: Path) -> None:
    write_run(tmp_path / "whole", "partition.block=4")
    (tmp_path / "whole" / "metrics.csv").unlink()
    for number in range(2):
        write_run(tmp_path / "whole" / "blocks" / f"{number:05d}", seed=number)
    for place, name in ((tmp_path, "whole"), (tmp_path / "whole", ".")):
        found = gather_runs(place)
        assert [run.name for run in found.runs] == [name]
        assert found.anomalies == []


def test_a_run_that_failed_in_the_sweep_and_was_ended_by_hand_counts(sweep: Path) -> None:
    write_json(sweep / "a2c-0.22-1/failed.json", {"reason": "out of luck"})
    assert run_of(sweep / "a2c-0.22-1").state == "done"
    found = gather_runs(sweep)
    assert "a2c-0.22-1" in {run.name for run in found.runs}
    assert "a2c-0.22-1" not in reasons(found)


def test_faults_of_a_run_are_listed(sweep: Path) -> None:
    (sweep / "a2c-0.16-0/summary.json").unlink()
    (sweep / "a2c-0.16-1/summary.json").write_text('{"frames": 3')
    (sweep / "a2c-0.16-2/summary.json").write_text('{"frames": 3}')
    (sweep / "a2c-0.22-0/config.yaml").write_text("a: [")
    write_json(sweep / "a2c-0.22-1/failed.json", {"reason": "out of luck"})
    (sweep / "a2c-0.22-2/failed.json").write_text("{")
    for seed in (1, 2):
        (sweep / f"a2c-0.22-{seed}/summary.json").unlink()
    for seed in range(3):
        (sweep / f"hindsight-0.22-{seed}/policy.npz").write_bytes(b"nothing")
    (sweep / "hindsight-0.16-0/problem.npz").unlink()
    (sweep / "hindsight-0.16-1/problem.npz").unlink()
    (sweep / "hindsight-0.16-2/problem.npz").unlink()
    found = gather_runs(sweep)
    said = reasons(found)
    assert len(found.runs) == 6
    assert said["a2c-0.16-0"] == "cut: it has no summary.json"
    assert said["a2c-0.16-1"].startswith("summary.json: not JSON")
    assert "digest" in said["a2c-0.16-2"]
    assert said["a2c-0.22-0"].startswith("config.yaml: ")
    assert said["a2c-0.22-1"] == "failed: out of luck"
    assert said["a2c-0.22-2"].startswith("failed: ")
    assert said["hindsight-0.22-1"].startswith("policy.npz: ")
    assert said["hindsight-0.16-1"].startswith("problem.npz: ")
    assert found.maps == []


def test_another_run_of_the_group_is_drawn_where_a_policy_is_missing(sweep: Path) -> None:
    seed = gather_runs(sweep).maps[0].seed
    (sweep / f"a2c-0.16-{seed}/policy.npz").unlink()
    found = gather_runs(sweep)
    assert (found.maps[0].method, found.maps[0].world) == ("a2c", "Z=5, c=0.16")
    assert found.maps[0].seed != seed
    assert list(reasons(found)) == [f"a2c-0.16-{seed}"]


def facts(**changed: Any) -> Change:
    """A summary with other figures and the right digest."""
    return lambda run: write_sealed(run / "summary.json", {**read_summary(run), **changed})


SPOILT: dict[str, tuple[Change, str]] = {
    "changed": (
        lambda run: (run / "summary.json").write_text(
            (run / "summary.json").read_text().replace("2.0", "3.0", 1).replace("4000", "5000")
        ),
        "summary.json: ",
    ),
    "deep": (lambda run: (run / "summary.json").write_text("[" * 10**5), "summary.json: "),
    "of another run": (
        lambda run: shutil.copy(run.parent / "a2c-0.22-1/summary.json", run / "summary.json"),
        "config.yaml: ",
    ),
    "policy": (facts(policy=True), "summary.json: "),
    "frames": (facts(frames="x"), "summary.json: "),
    "no time": (facts(cpu_seconds=None), "summary.json: "),
    "no length": (facts(policy={"aihtr": 9.0}), "summary.json: "),
    "curve": (
        lambda run: [(run / "metrics.csv").write_text("aihtr\nx\n"), sealed_again(run)],
        "metrics.csv: ",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_run_that_was_changed_is_listed_and_the_others_are_read(case: str, sweep: Path) -> None:
    change, start = SPOILT[case]
    change(sweep / "a2c-0.16-0")
    found = gather_runs(sweep)
    assert len(found.runs) == 11
    assert reasons(found)["a2c-0.16-0"].startswith(start)
    assert "\n" not in reasons(found)["a2c-0.16-0"]


@pytest.mark.parametrize("case", ["policy", "frames", "no length"])
def test_a_changed_summary_is_refused_when_it_is_read_not_when_it_is_shown(
    case: str, sweep: Path
) -> None:
    change, start = SPOILT[case]
    run = sweep / "a2c-0.16-0"
    repr(load_run(run))
    change(run)
    with pytest.raises(UserError, match=start):
        load_run(run)


def test_a_run_of_a_version_with_other_options_counts(sweep: Path) -> None:
    file = sweep / "a2c-0.16-0/config.yaml"
    file.write_text(file.read_text().replace("  radius: 1\n", "  radius: 1\n  later: 3\n"))
    sealed_again(file.parent)
    assert len(gather_runs(sweep).runs) == 12


def test_a_run_under_way_is_not_called_cut(sweep: Path) -> None:
    (sweep / "a2c-0.16-0/summary.json").unlink()
    with locked(sweep / "a2c-0.16-0"):
        assert reasons(gather_runs(sweep))["a2c-0.16-0"] == "still running"


def test_planned_runs_that_are_missing_are_listed(sweep: Path) -> None:
    shutil.rmtree(sweep / "a2c-0.16-1")
    assert gather_runs(sweep).anomalies == []
    plan(sweep, *sorted(path.name for path in sweep.iterdir()), "ppo-0.16-0")
    found = gather_runs(sweep)
    assert reasons(found) == {"ppo-0.16-0": "not started"}
    assert found.manifest["planned"] == 12


def test_runs_of_other_versions_and_repeated_runs_are_listed(sweep: Path) -> None:
    shutil.rmtree(sweep / "a2c-0.16-1")
    other = VERSIONS | {"torch": "1.0"}
    write_run(sweep / "a2c-0.16-1", "grid.size=3", "algo=a2c", seed=1, versions=other)
    shutil.copytree(sweep / "a2c-0.22-0", sweep / "z")
    found = gather_runs(sweep)
    assert reasons(found) == {
        "a2c-0.16-1": "other versions: torch 1.0, most have 2.13.0",
        "z": "the same config as a2c-0.22-0, which counts",
    }
    assert len(found.runs) == 12


def test_runs_of_a_file_that_has_changed_are_of_another_world(tmp_path: Path) -> None:
    file = tmp_path / "motion.npy"
    words = ("grid.size=2", "kernel=table", f"kernel.path={file}")
    for name, stay, algo, seed, cost in (
        ("a0", 0.5, "a2c", 0, 0.1),
        ("a1", 0.5, "a2c", 1, 0.1),
        ("b0", 0.9, "a2c", 0, 0.1),
        ("b1", 0.9, "ppo", 0, 0.1),
        ("c0", 0.9, "a2c", 0, 0.2),
        ("c1", 0.5, "a2c", 0, 0.2),
    ):
        np.save(file, stay * np.eye(4))
        write_run(tmp_path / name, *words, f"algo={algo}", seed=seed, cost=cost)
    found = gather_runs(tmp_path)
    other = {run: text.split()[-1] for run, text in reasons(found).items()}
    assert other == {"b0": "a0", "b1": "a0", "c1": "c0"}
    grouped = study(found.runs)
    names = {tuple(run.name for run in runs) for runs in grouped.groups.values()}
    assert names == {("a0", "a1"), ("b0",), ("b1",), ("c0",), ("c1",)}
    lines = [
        [grouped.of(world, "a2c")[0].name for world in worlds.values()]
        for _, worlds in panels(grouped)
    ]
    assert sorted(lines) == [["a0", "c1"], ["b0", "c0"]]


def test_a_run_that_was_quiet_is_the_same_run(sweep: Path) -> None:
    loud = sweep / "loud"
    shutil.copytree(sweep / "a2c-0.22-0", loud)
    text = (loud / "config.yaml").read_text()
    (loud / "config.yaml").write_text(text.replace("quiet: true", "quiet: false"))
    plain = read_summary(loud) | {"config_sha256": "another"}
    write_summary(loud, {key: value for key, value in plain.items() if key != "files"})
    assert reasons(gather_runs(sweep)) == {"loud": "the same config as a2c-0.22-0, which counts"}


@pytest.mark.parametrize("content", [None, "runs/notes.txt"])
def test_a_folder_without_runs_is_refused(content: str | None, tmp_path: Path) -> None:
    if content:
        (tmp_path / content).parent.mkdir()
        (tmp_path / content).touch()
    with pytest.raises(UserError, match=f"sweep={tmp_path}"):
        gather_runs(tmp_path)


@pytest.mark.parametrize("folder", ["../outside", "{outside}", "a2c-0.16-0/../../outside", "link"])
def test_a_plan_does_not_lead_out_of_the_sweep(folder: str, sweep: Path) -> None:
    outside = sweep.parent / "outside"
    shutil.copytree(sweep / "a2c-0.16-0", outside)
    (outside / "failed.json").write_text('{"reason": "SECRET"}')
    (sweep / "link").symlink_to(outside)
    plan(sweep, folder.format(outside=outside))
    assert not any("SECRET" in text for text in reasons(gather_runs(sweep)).values())
    assert not any("SECRET" in each.reason for each in watch.statuses(sweep))


@pytest.mark.parametrize("name", [3, "a\0b", "\ud800"])
def test_a_plan_of_rubbish_is_refused_in_one_line(name: object, sweep: Path) -> None:
    if isinstance(name, int):
        (sweep / "sweep.json").write_text('{"jobs": [{}], "line": "", "command": "train"}')
    else:
        plan(sweep, name)
    with pytest.raises(UserError, match=r"sweep\.json") as caught:
        gather_runs(sweep)
    assert "\n" not in str(caught.value)


EVIL = ["=<script>alert(1)<@BODY@", "@$x^{$\\input{x}{}~^&%#_", "\x1b]0;t\x07a\nb\u202e", "[x]"]


def test_a_folders_name_is_a_name_everywhere(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for run, name in zip(sorted(sweep.iterdir()), EVIL, strict=False):
        run.rename(sweep / name)
        (sweep / f"failed {name}").mkdir()
        (sweep / f"failed {name}/failed.json").write_text(json.dumps({"reason": name}))
    (sweep / os.fsdecode(b"r\xff")).mkdir()
    (sweep / os.fsdecode(b"r\xff") / "config.yaml").touch()
    save_results(gather_runs(sweep), tmp_path)
    found = load_results(tmp_path)
    assert len(found.runs) == 12
    report = build(
        dataclasses.replace(found, manifest={**found.manifest, "line": "".join(EVIL)}, maps=[])
    )
    page = report.html()
    assert "<script>alert" not in page
    assert page.count("</body>") == 1
    assert "\x1b" not in page
    assert "r\\udcff" in page
    for table in report.tables:
        assert "\\input" not in table.latex()
        cells = (cell for line in table.csv().splitlines() for cell in line.split(","))
        assert not any(cell.startswith(("=", "@")) for cell in cells)
    watch.watch(sweep, make_console(quiet=False), 0.01)
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "[x]: done" in said


def test_a_policy_without_its_values_is_listed_too(sweep: Path) -> None:
    place = sweep / f"a2c-0.16-{gather_runs(sweep).maps[0].seed}"
    table, _ = load_policy(place / "policy.npz")
    save_policy(place / "policy.npz", table)
    write_summary(place, read_summary(place))
    assert "not the policy of this run" in reasons(gather_runs(sweep))[place.name]
