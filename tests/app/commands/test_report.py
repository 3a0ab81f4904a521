"""`report` as a user types it."""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

import pytest

from tests.reports.sweeps import write_sweep
from tests.typed import refused
from trackmdp.app.cli import main
from trackmdp.app.commands import report
from trackmdp.errors import adding
from trackmdp.reports.gather import run_folders
from trackmdp.reports.results import Results
from trackmdp.training.lock import is_locked


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("sweep"), 0.16)


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def test_a_report_holds_page_figures_tables_and_what_it_was_made_from(
    sweep: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, held = report.save_results, list[bool]()

    def saved(found: Results, folder: Path) -> None:
        held.append(is_locked(folder))
        whole(found, folder)

    monkeypatch.setattr(report, "save_results", saved)
    assert main(["report", f"sweep={sweep}"]) == 0
    assert held == [True]  # one report at a time is written to a folder
    assert capsys.readouterr().out == f"6 runs; report in {sweep / 'report/report.html'}\n"
    made = contents(sweep / "report")
    tables = {f"tables/outcome.{ending}" for ending in ("csv", "tex")} | {"tables/runs.csv"}
    assert made.keys() >= tables | {"report.html", "results.npz"}
    assert made.keys() >= {f"figures/learning-frames.{ending}" for ending in ("svg", "png", "csv")}
    rows = list(csv.DictReader(made["tables/runs.csv"].decode().splitlines()))
    assert {row["folder"] for row in rows} == {path.name for path in sweep.iterdir()} - {"report"}
    assert b"the paper" not in made["report.html"].lower()

    assert len(run_folders(sweep, None)) == 6  # the report that lies there is no run

    # sweeps are reported one by one; from what a report keeps, and from nothing else, the same one is made again
    line = ["report", "-m", f"sweep={sweep},{sweep}/report", "quiet=true", "hydra.sweep.dir=all"]
    assert main(line) == 0
    assert capsys.readouterr().out == ""
    pages = list(Path("all").glob("*/report.html"))
    assert [contents(page.parent).items() >= made.items() for page in pages] == [True, True]


def test_a_missing_run_is_named_in_one_line_and_in_the_page(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = shutil.copytree(sweep, tmp_path / "cut", ignore=shutil.ignore_patterns("report"))
    (cut / "a2c-0.16-0/summary.json").unlink()
    (cut / "a2c-0.16-1/summary.json").write_text("{")
    assert main(["report", f"sweep={cut}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == ("missing or mixed, the first of 2: a2c-0.16-0: cut: it has no summary.json")
    assert lines[1].startswith("4 runs; report in")
    page = (cut / "report/report.html").read_text(encoding="utf-8")
    assert "a2c-0.16-1" in page


def test_a_sweep_in_which_nothing_finished_is_reported_as_well(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "s/a").mkdir(parents=True)
    (tmp_path / "s/a/failed.json").write_text('{"reason": "out of luck"}')
    assert main(["report", f"sweep={tmp_path / 's'}"]) == 0
    assert "a: failed: out of luck" in capsys.readouterr().out
    assert "out of luck" in (tmp_path / "s/report/report.html").read_text(encoding="utf-8")


def test_mistakes_end_in_one_line(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    assert (
        refused(capsys, "report")
        == "sweep: missing, expected the folder of a sweep or an earlier report"
    )
    assert (
        refused(capsys, "report", "sweep=nowhere")
        == f"sweep={Path.cwd() / 'nowhere'}: no such folder"
    )
    assert "not the root of the file system" in refused(
        capsys, "report", "sweep=/", "hydra.run.dir=../out"
    )
    assert "no runs in there" in refused(capsys, "report", "sweep=../empty")
    assert "no runs in there" in refused(capsys, "report", "sweep=../empty", "watch=true")
    assert not list((tmp_path / "empty").iterdir())
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert adding("report") in refused(capsys, "report", f"sweep={sweep}", "hydra.run.dir=../out")
    assert not (tmp_path / "out").exists()


def test_a_finished_sweep_is_watched_at_once(
    sweep: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", f"sweep={sweep}", "watch=true"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7
    assert lines[-1] == "6 runs: 6 done"
    assert all(", gap " in line for line in lines[:-1])


@pytest.mark.slow
def test_a_sweep_as_typed_is_reported_with_what_failed(capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "seed=0,1",
        "grid.size=3,0",
        "algo=hindsight",
        "algo.updates=2",
        "algo.total_frames=2000",
        "algo.frames_per_batch=1000",
    ]
    assert main(["train", "-m", *words, "quiet=true", "hydra.sweep.dir=all"]) == 2
    capsys.readouterr()
    assert main(["report", "sweep=all"]) == 0, capsys.readouterr().err
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("missing or mixed, the first of 2: ")
    assert "failed: grid.size=0: expected an integer >= 1, or a pair of them (cells)" in lines[0]
    assert lines[1].startswith("2 runs; report in")
    page = Path("all/report/report.html").read_text(encoding="utf-8")
    assert "2 of 4 planned runs" in page
    assert "trackmdp train -m seed=0,1 grid.size=3,0" in page
    assert str(Path.cwd()) not in page


def test_to_watch_a_sweep_nothing_is_written(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file in the place of the report's folder stands for a sweep of somebody else's, which cannot be written to."""
    own = shutil.copytree(sweep, tmp_path / "own", ignore=shutil.ignore_patterns("report"))
    (own / "report").touch()
    before = own.stat().st_mtime_ns
    assert main(["report", f"sweep={own}", "watch=true"]) == 0, capsys.readouterr().err
    assert own.stat().st_mtime_ns == before
