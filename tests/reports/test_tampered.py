"""Sweeps that somebody changed by hand, or meant to deceive with: the run is named, and the others are shown."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import trackmdp as tm
from tests.reports.sweeps import write_run
from trackmdp.durable import csv_text, write_sealed
from trackmdp.errors import UserError
from trackmdp.reports import watch
from trackmdp.reports.gather import gather_runs
from trackmdp.reports.page import build
from trackmdp.reports.results import is_stored, load_results, pack_policies, save_results, unpack_policies
from trackmdp.reports.tables import Column, Table
from trackmdp.training.folders import read_summary, write_summary
from trackmdp.untrusted import decoded, read_object, sealed
from trackmdp.world.files import load_npz, npz_bytes

Change = Callable[[Path], Any]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    for name, cost in (("a", 0.16), ("b", 0.22), ("c", 0.3)):
        write_run(folder / name, "grid.size=3", cost=cost, seed=0, wrong=2)
    return folder


@pytest.fixture
def sweep(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "sweep")
    return tmp_path / "sweep"


def text(name: str, content: str) -> Change:
    return lambda run: (run / name).write_text(content)


def resealed(**facts: Any) -> Change:
    """A summary with other figures and the right digest."""

    def change(run: Path) -> None:
        write_sealed(run / "summary.json", {**read_summary(run), **facts})

    return change


def theirs(name: str) -> Change:
    return lambda run: shutil.copy(run.parent / "b" / name, run / name)


def fifo(run: Path) -> None:
    (run / "summary.json").unlink()
    os.mkfifo(run / "summary.json")


def link(run: Path) -> None:
    shutil.move(run / "summary.json", run / "elsewhere.json")
    (run / "summary.json").symlink_to(run / "elsewhere.json")


SPOILT: dict[str, tuple[Change, str]] = {
    "aihtr": (lambda run: _edit(run, aihtr=999.0), "summary.json: its content does not match its digest"),
    "empty": (text("summary.json", ""), "summary.json: not JSON"),
    "deep": (text("summary.json", "[" * 10**5), "summary.json: not JSON"),
    "list": (text("summary.json", "[]"), "summary.json: expected a JSON object"),
    "pipe": (fifo, "cut: it has no summary.json"),
    "link": (link, "summary.json: a symbolic link"),
    "summary of another run": (theirs("summary.json"), "config.yaml: not the file that this run left"),
    "config of another run": (theirs("config.yaml"), "config.yaml: not the file that this run left"),
    "policy": (resealed(policy=True), "summary.json: not the summary of a run"),
    "frames": (resealed(frames="x"), "summary.json: not the summary of a run"),
    "1e308": (resealed(wall_seconds=1e308), "summary.json: not the summary of a run"),
    "no time": (resealed(cpu_seconds=None), "summary.json: not the summary of a run"),
    "no aihtr": (resealed(policy={"expected_length": 9.0}), "summary.json: not the summary of a run"),
    "no length": (resealed(policy={"aihtr": 9.0}), "summary.json: not the summary of a run"),
    "length 0": (resealed(policy={"aihtr": 9.0, "expected_length": 0}), "summary.json: not the summary of a run"),
    "versions": (resealed(versions={"torch": {"a": [1]}}), "summary.json: not the summary of a run"),
    "no files": (resealed(files=None), "summary.json: names no files"),
}


def _edit(run: Path, **figures: Any) -> None:
    summary = json.loads((run / "summary.json").read_text())
    summary["policy"] |= figures
    (run / "summary.json").write_text(json.dumps(summary))


@pytest.mark.parametrize("case", SPOILT)
def test_a_run_that_was_changed_is_named_and_the_others_are_read(case: str, sweep: Path) -> None:
    change, said = SPOILT[case]
    change(sweep / "a")
    found = gather_runs(sweep)
    assert [run.name for run in found.runs] == ["b", "c"]
    (anomaly,) = [each for each in found.anomalies if each.run == "a"]
    assert anomaly.text.startswith(said)
    assert "\n" not in anomaly.text


def test_a_folder_that_goes_meanwhile_is_passed_over(sweep: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = os.scandir

    def scandir(path: Any) -> Any:  # a number, where a folder is removed
        if str(path) == str(sweep / "b"):
            shutil.rmtree(path, ignore_errors=True)
        return listed(path)

    monkeypatch.setattr("os.scandir", scandir)
    assert [run.name for run in gather_runs(sweep).runs] == ["a", "c"]


@pytest.mark.parametrize("name", ["policy.npz", "kernel.npz"])
def test_what_another_run_left_is_not_used(name: str, sweep: Path) -> None:
    content = bytearray((sweep / "a" / name).read_bytes())
    content[-30] ^= 1
    (sweep / "a" / name).write_bytes(content)
    found = gather_runs(sweep)
    assert any(each.run == "a" and f"{name}: not the file that this run left" in each.text for each in found.anomalies)
    assert "a" not in (found.policies if name == "policy.npz" else found.motions)


@pytest.mark.parametrize(
    "rows",
    [
        "1,100,nan,1\n",
        "1,100,1e308,1\n",
        "2,200,1,1\n1,100,1,1\n",
        "1,-5,1,1\n",
        "1,100,1,-1\n",
        '1,100,"',
        "x,1,1,1\n",
    ],
)
def test_a_curve_of_rubbish_is_no_curve(rows: str, sweep: Path) -> None:
    (sweep / "a/metrics.csv").write_text("iteration,frames,aihtr,seconds\n" + rows)
    found = gather_runs(sweep)
    assert "a" not in found.curves
    assert any((each.run, each.text) == ("a", "no learning curve") for each in found.anomalies)


@pytest.mark.parametrize("folder", ["../outside", "{outside}", "a/../../outside", "link"])
def test_a_plan_does_not_lead_out_of_the_sweep(folder: str, sweep: Path) -> None:
    outside = sweep.parent / "outside"
    shutil.copytree(sweep / "a", outside)
    (outside / "failed.json").write_text('{"reason": "SECRET"}')
    (sweep / "link").symlink_to(outside)
    jobs = [{"folder": folder.format(outside=outside), "overrides": []}]
    (sweep / "sweep.json").write_text(json.dumps({"command": "train", "line": "", "jobs": jobs}))
    assert not any("SECRET" in each.text for each in gather_runs(sweep).anomalies)
    assert not any("SECRET" in each.reason for each in watch.statuses(sweep))


@pytest.mark.parametrize(
    "jobs",
    [3, [1], [{}], *([{"folder": name}] for name in (3, "a\0b", "x" * 9000, "x" * 300, "²", "\ud800", "loop"))],
)
def test_a_plan_of_rubbish_is_passed_over(jobs: Any, sweep: Path) -> None:
    (sweep / "loop").symlink_to("loop")
    (sweep / "sweep.json").write_text(json.dumps({"command": "train", "line": [1], "jobs": jobs}))
    assert len(gather_runs(sweep).runs) == 3
    assert watch.watch(sweep, Console(quiet=True), 0.01) == 3


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("plan.json", '{"iterations": "x", "upper_bound": []}'),
        ("plan.json", '{"iterations": -1, "upper_bound": 1e308}'),
        ("plan.json", "[" * 10**5),
        ("metrics.csv", "iteration,seconds\n²,1\n"),
        ("metrics.csv", "iteration,seconds\n1,x\n2,nan\n"),
        ("metrics.csv", "\0" * 500),
        ("metrics.csv", "a" * 10**6 + "\n"),
    ],
)
def test_watching_survives_what_it_reads(name: str, content: str, sweep: Path) -> None:
    (sweep / "a" / name).write_text(content)
    (sweep / "a/summary.json").unlink()
    states = {status.name: status for status in watch.statuses(sweep)}
    assert states["a"].state == "cut"
    assert watch._line(states["a"])


def test_stored_results_that_were_changed_are_refused(sweep: Path, tmp_path: Path) -> None:
    stored = tmp_path / "stored"
    stored.mkdir()
    save_results(gather_runs(sweep), stored)
    assert len(load_results(stored).runs) == 3
    whole = {file.name: file.read_bytes() for file in stored.iterdir()}
    for name, content in whole.items():
        changed = bytearray(content)
        changed[len(changed) // 2] ^= 1
        (stored / name).write_bytes(changed)
        with pytest.raises(UserError, match=f"sweep={re.escape(str(stored))}"):
            load_results(stored)
        (stored / name).write_bytes(content)
    manifest = json.loads(whole["manifest.json"])
    spoilt: list[dict[str, Any]] = [{"settings": 3}, {"problems": [{"a": 1}]}, {"files": []}, {"config_sha256": None}]
    spoilt += [{"line": [1]}, {"planned": "x"}, {"cpu_seconds": []}, {"versions": "x"}, {"machines": [{"a": 1}]}]
    for facts in spoilt:
        plain = {key: value for key, value in {**manifest, **facts}.items() if key != "sha256"}
        (stored / "manifest.json").write_text(json.dumps(sealed(plain)))
        with pytest.raises(UserError, match="not stored results that can be read"):
            load_results(stored)
    (stored / "manifest.json").write_text("[" * 10**5)
    assert not is_stored(stored)


@pytest.mark.parametrize(("column", "value"), [("seed", "x"), ("aihtr", ""), ("frames", "nan"), ("qmdp_aihtr", "1e99")])
def test_stored_figures_of_another_kind_are_refused(column: str, value: str, sweep: Path, tmp_path: Path) -> None:
    save_results(gather_runs(sweep), tmp_path)
    rows = list(csv.DictReader((tmp_path / "runs.csv").read_text().splitlines()))
    rows[1][column] = value
    (tmp_path / "runs.csv").write_text(csv_text(rows[0], [list(row.values()) for row in rows]))
    manifest = read_object(tmp_path / "manifest.json")
    manifest["files"]["runs.csv"] = hashlib.sha256((tmp_path / "runs.csv").read_bytes()).hexdigest()
    del manifest["sha256"]
    (tmp_path / "manifest.json").write_text(json.dumps(sealed(manifest)))
    with pytest.raises(UserError, match="not stored results that can be read"):
        load_results(tmp_path)


@pytest.mark.parametrize("change", [lambda values: values[None], lambda values: values[:-1]])
def test_a_stored_policy_of_other_lengths_is_refused(change: Any, sweep: Path) -> None:
    stored = load_npz(io.BytesIO(pack_policies(gather_runs(sweep).policies)))
    assert len(unpack_policies(npz_bytes(stored))) == 3
    with pytest.raises(UserError, match="not policies"), decoded("x", "policies"):
        unpack_policies(npz_bytes({**stored, "values": change(stored["values"])}))


EVIL = ["=<script>alert(1)<@BODY@", "@$x^{$\\input{x}{}~^&%#_", "\x1b]0;t\x07a\nb\u202e", "[x]"]


def test_a_folders_name_is_a_name_everywhere(sweep: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in EVIL:
        shutil.copytree(sweep / "a", sweep / name)
        (sweep / f"failed {name}").mkdir()
        (sweep / f"failed {name}/failed.json").write_text(json.dumps({"reason": name}))
    found = gather_runs(sweep)
    report = build(dataclasses.replace(found, manifest=found.manifest | {"line": "".join(EVIL)}))
    page = report.html()
    assert "<script>alert" not in page
    assert page.count("</body>") == 1
    assert "\x1b" not in page
    for table in report.tables:
        assert not re.search(r"\\(input|write|immediate)", table.latex())
        assert not any(cell.startswith(("=", "@")) for line in table.csv().splitlines() for cell in line.split(","))
    watch.watch(sweep, Console(force_terminal=False), 0.01)
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "[x]: done" in said


@pytest.mark.parametrize(("other", "value"), [({"size": 4}, 1.0), ({"size": 3, "t_max": 3}, 1.0), ({"size": 3}, 1e308)])
def test_a_policy_of_another_grid_is_not_drawn(other: dict[str, Any], value: float, sweep: Path) -> None:
    policy = tm.Policy.all_on(tm.make_world("random_walk", **other))
    policy.save(sweep / "a/policy.npz", np.full(policy.task.num_cells, value))
    write_summary(sweep / "a", {key: value for key, value in read_summary(sweep / "a").items() if key != "files"})
    found = gather_runs(sweep)
    assert "a" not in found.policies
    assert any(each.run == "a" and "not the policy of" in each.text for each in found.anomalies)


def test_what_has_no_form_in_utf_8_is_shown_with_escapes(sweep: Path, tmp_path: Path) -> None:
    (sweep / os.fsdecode(b"r\xff")).mkdir()
    shutil.copy(sweep / "a/config.yaml", sweep / os.fsdecode(b"r\xff"))
    resealed(versions={"torch": "\ud800"})(sweep / "b")
    save_results(gather_runs(sweep), tmp_path)
    found = load_results(tmp_path)
    assert [run.name for run in found.runs] == ["a", "b", "c"]
    assert ("r\\udcff", "its folder's name is not UTF-8") in {(each.run, each.text) for each in found.anomalies}
    assert "torch \\ud800" in build(found).html()


def test_a_setting_is_a_text_everywhere(sweep: Path, tmp_path: Path) -> None:
    config = sweep / "a/config.yaml"
    evil = json.dumps("\x1b]0;t\x07")
    config.write_text(config.read_text().replace("border: renormalize", f"border: {evil}\n  {evil}: 1"))
    write_summary(sweep / "a", {key: value for key, value in read_summary(sweep / "a").items() if key != "files"})
    found = gather_runs(sweep)
    assert found.runs[0].settings["kernel.border"] == "\\x1b]0;t\\x07"
    assert "kernel.\\x1b]0;t\\x07" in found.runs[0].settings
    changed = dataclasses.replace(found.runs[0], settings={**found.runs[0].settings, "kernel.border": "\x1b"})
    save_results(dataclasses.replace(found, runs=[changed, *found.runs[1:]]), tmp_path)
    assert load_results(tmp_path).runs[0].settings["kernel.border"] == "\\x1b"


def test_latex_letters_are_letters() -> None:
    table = Table("t", "a\ncaption", [Column("x")], [["\\ { } $ ~ ^ & % # _"]])
    lines = table.latex().splitlines()
    assert lines[0] == "% a caption"
    assert lines[5] == (r"\textbackslash{} \{ \} \$ \textasciitilde{} \textasciicircum{} \& \% \# \_ \\")


def test_a_cell_of_a_spreadsheet_is_no_formula() -> None:
    rows = [[evil] for evil in ("=1+1", "+1", "-1", "@SUM(1)", "\t=1")]
    assert Table("t", "", [Column("x")], rows).csv().splitlines()[1:] == [f"'{row[0]}" for row in rows]
    assert Table("t", "", [Column("x")], [[-1.5]]).csv() == "x\n-1.5\n"


def test_a_summary_names_the_files_of_its_run(tmp_path: Path) -> None:
    np.savez(tmp_path / "kernel.npz", kernel=np.eye(2))
    write_summary(tmp_path, {"frames": 3})
    assert read_summary(tmp_path)["files"].keys() == {"kernel.npz"}
