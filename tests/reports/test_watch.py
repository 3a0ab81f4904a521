"""All runs of a sweep at the terminal, from their files alone."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from rich.console import Console

import trackmdp as tm
from tests.helpers import small_world
from trackmdp.durable import write_json, write_sealed
from trackmdp.errors import UserError
from trackmdp.reports import watch
from trackmdp.reports.watch import Status, statuses
from trackmdp.training.lock import locked

HEAD = "iteration,frames,aihtr,seconds\n"


def sweep_of(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    jobs = [{"folder": name, "overrides": []} for name in names]
    write_json(folder / "sweep.json", {"command": "train", "line": "", "jobs": jobs})
    return folder


def begin(place: Path, rows: str = "") -> Path:
    """A run with a plan of 100 iterations and the upper bound 50."""
    place.mkdir()
    (place / "config.yaml").touch()
    write_json(place / "plan.json", {"iterations": 100, "upper_bound": 50.0})
    (place / "metrics.csv").write_text(HEAD + rows)
    return place


def finish(place: Path) -> None:
    write_sealed(place / "summary.json", {"policy": {"aihtr": 49.0}, "optimal": {"upper": 49.5}})


def test_every_state_is_read_from_the_folder(tmp_path: Path) -> None:
    sweep = sweep_of(tmp_path / "s", "a", "b", "c", "d", "e")
    finish(begin(sweep / "a"))
    begin(
        sweep / "b", "20,2000,30.0,4.0\n25,2500,,5.0\n26,2600,,5"
    )  # the last row is being written
    begin(sweep / "c", "50,5000,45.0,10.0\n")
    (sweep / "d").mkdir()
    write_json(sweep / "d/failed.json", {"reason": "out of luck"})
    with locked(sweep / "b"):
        found = statuses(sweep)
    assert found == [
        Status("a", "done", 1.0, 0.5, 0.0),
        Status("b", "running", 0.25, 20.0, 15.0),
        Status("c", "cut", 0.5, 5.0, 10.0),
        Status("d", "failed", reason="out of luck"),
        Status("e", "waiting"),
    ]


def test_where_the_last_iteration_may_take_longest_the_time_left_is_the_least(
    tmp_path: Path,
) -> None:
    place = begin(tmp_path / "a", "20,2000,30.0,4.0\n")
    write_json(place / "plan.json", {"iterations": 100, "upper_bound": 50.0, "least": True})
    with locked(place):
        (status,) = statuses(tmp_path)
    assert status.cells[-1] == "at least 16 s left"
    few = {"total_frames": 64, "frames_per_batch": 64, "envs": 64}
    tm.train(small_world(), "model_based", folder=tmp_path / "b", **few)
    assert json.loads((tmp_path / "b/plan.json").read_text())["least"]


def test_of_a_run_by_blocks_those_that_are_done_are_counted(tmp_path: Path) -> None:
    place = tmp_path / "a"
    for number in range(3):
        (place / "blocks" / f"{number:05d}").mkdir(parents=True)
    (place / "config.yaml").touch()
    write_json(place / "plan.json", {"blocks": 4})
    finish(place / "blocks" / "00000")
    with locked(place):
        assert statuses(tmp_path) == [Status("a", "running", 0.25)]


def test_only_the_end_of_a_long_table_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watch, "TAIL", 40)
    sweep = sweep_of(tmp_path / "s", "a")
    begin(sweep / "a", "".join(f"{i},{100 * i},{i / 2},{i / 10}\n" for i in range(1, 81)))
    (found,) = statuses(sweep)
    assert (found.share, found.gap) == (0.8, 10.0)
    assert found.left == pytest.approx(2.0)


@pytest.mark.parametrize("text", ["", "iteration", HEAD, HEAD + "1", HEAD + ",,,\nx,y,z,w\n"])
def test_a_table_without_a_whole_row_is_no_progress_yet(text: str, tmp_path: Path) -> None:
    sweep = sweep_of(tmp_path / "s", "a")
    (begin(sweep / "a") / "metrics.csv").write_text(text)
    assert statuses(sweep) == [Status("a", "cut")]


def said(
    sweep: Path,
    monkeypatch: pytest.MonkeyPatch,
    *steps: Callable[[], object],
    terminal: bool = False,
) -> str:
    """What is shown while `steps` happen, one between each look and the next."""
    left = list(steps)
    monkeypatch.setattr(watch.time, "sleep", lambda seconds: left.pop(0)())
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100, height=30, highlight=False)
    watch.watch(sweep, console, every=1.0)
    assert not left
    return out.getvalue()


def test_piped_a_line_comes_for_each_change_until_all_are_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = sweep_of(tmp_path / "s", "a", "b")
    with ExitStack() as running:
        running.enter_context(locked(sweep))
        one = running.enter_context(ExitStack())

        def first() -> None:
            one.enter_context(locked(begin(sweep / "a", "20,2000,30.0,4.0\n")))

        def second() -> None:
            finish(sweep / "a")
            one.close()

        def third() -> None:
            (sweep / "b").mkdir()
            write_json(sweep / "b/failed.json", {"reason": "out of luck"})

        lines = said(sweep, monkeypatch, first, second, lambda: None, third).splitlines()
    assert lines == [
        "a: running, 20 %, gap 20.00, 16 s left",
        "a: done, gap 0.50",
        "b: failed: out of luck",
        "2 runs: 1 done, 1 failed",
    ]


def test_at_a_terminal_that_cannot_redraw_lines_come_as_piped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "dumb")
    sweep = sweep_of(tmp_path / "s", "a")
    with ExitStack() as running:
        running.enter_context(locked(begin(sweep / "a", "20,2000,30.0,4.0\n")))
        lines = said(sweep, monkeypatch, running.close, terminal=True).splitlines()
    assert lines[0] == "a: running, 20 %, gap 20.00, 16 s left"


def test_without_a_sweep_that_runs_there_is_nothing_to_wait_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = sweep_of(tmp_path / "s", "a", "b")
    begin(sweep / "a", "50,5000,45.0,10.0\n")
    assert said(sweep, monkeypatch).splitlines()[-1] == "2 runs: 1 cut, 1 waiting"


def test_at_a_terminal_a_table_shows_progress_gap_and_time_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = sweep_of(tmp_path / "s", *(f"run{i}" for i in range(40)))
    with ExitStack() as running:
        running.enter_context(locked(begin(sweep / "run7", "20,2000,30.0,4.0\n")))

        def end() -> None:
            finish(sweep / "run7")
            running.close()

        shown = said(sweep, monkeypatch, end, terminal=True)
    first = shown[: shown.index("40 runs")]
    assert all(word in first for word in ("run7", "running", "20 %", "20.00", "16 s"))
    assert first.index("run7") < first.index("run0")  # those under way come first
    assert "and 16 more" in first
    assert "40 runs: 1 done, 39 waiting" in shown


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no runs in there"):
        watch.watch(tmp_path, Console(file=io.StringIO()), every=1.0)
