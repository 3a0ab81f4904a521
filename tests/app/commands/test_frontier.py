"""`frontier` as it is typed."""

from __future__ import annotations

import csv
import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

import trackmdp as tm
from tests.typed import refused, typed
from trackmdp.app.cli import main
from trackmdp.app.commands import frontier as command
from trackmdp.solvers.frontier import FrontierProgress

SMALL = ["grid.size=4", "cost.safe=0"]


def report(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "frontier.json").read_text(encoding="utf-8"))
    return content


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "frontier.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_files_hold_every_corner_and_its_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a"
    assert main(["frontier", *SMALL, f"hydra.run.dir={folder}"]) == 0
    world = tm.make_world(size=4, safe_cost=0)
    found = tm.frontier(world)
    content, lines = report(folder), rows(folder)
    assert len(lines) == len(content["corners"]) == len(found.corners)
    for number, (line, row, corner) in enumerate(
        zip(lines, content["corners"], found.corners, strict=True)
    ):
        assert (int(line["corner"]), line["certified"], row["certified"]) == (number, "True", True)
        assert float(line["sensors_per_step"]) == row["sensors_per_step"] == corner.sensors
        assert float(line["accuracy"]) == row["net_accuracy"] == corner.accuracy
        assert row["aihtr"] == corner.lower
    assert lines[-1]["gap_to_next"] == ""
    assert content["certified"] is True
    assert content["gap"] == found.gap <= content["resolution"] == 1e-3
    printed = capsys.readouterr().out
    assert "net" not in printed.replace("kernel", "")
    assert "certified: no policy is more than " in printed
    words = [f"baseline.file={folder}/corners/2/sets.json", f"cost.sensor={lines[2]['price']}"]
    words += ["baseline=sets", "episodes=0", "quiet=true", f"hydra.run.dir={tmp_path / 'b'}"]
    assert main(["evaluate", *SMALL, *words]) == 0
    valued = json.loads((tmp_path / "b" / "evaluation.json").read_text(encoding="utf-8"))["exact"]
    assert valued["aihtr"] == pytest.approx(float(lines[2]["aihtr"]), abs=1e-12)
    assert valued["accuracy"] == pytest.approx(float(lines[2]["accuracy"]), abs=1e-12)


def test_both_questions_are_answered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["grid.size=4", "accuracy=0.95", "sensors=0.5", f"hydra.run.dir={tmp_path / 'a'}"]
    assert main(["frontier", *words]) == 0
    content = report(tmp_path / "a")
    accurate, spent = content["answers"]["accuracy"], content["answers"]["sensors"]
    assert accurate["accuracy"] == pytest.approx(0.95)
    assert spent["sensors_per_step"] == pytest.approx(0.5)
    for answer in (accurate, spent):
        assert sum(part["probability"] for part in answer["parts"]) == pytest.approx(1.0)
        above, below = (content["corners"][part["corner"]] for part in answer["parts"])
        assert below["accuracy"] < answer["accuracy"] < above["accuracy"]
        assert answer["net_accuracy"] <= answer["net_bound"]
    printed = capsys.readouterr().out
    assert "accuracy=0.95: " in printed
    assert "sensors=0.5: " in printed
    assert "95.00 %" in printed
    # D is the sum of all prices, and is said to count.
    assert "2.56 (D/r) for each safe action" in printed


@pytest.mark.usefixtures("little_search")
def test_an_open_bracket_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["kernel=heading", "grid.size=3", "resolution=0.5", f"hydra.run.dir={tmp_path / 'a'}"]
    assert main(["frontier", *words]) == 0
    content = report(tmp_path / "a")
    assert content["certified"] is False
    open_ = [row for row in content["corners"] if not row["certified"]]
    assert open_
    assert all(row["aihtr"] < row["aihtr_upper"] for row in open_)
    printed = capsys.readouterr().out
    assert f"< {open_[0]['aihtr_upper']:,.3f}" in printed
    assert "not closed: no policy is more than " in printed


def test_prices_that_differ_stay_ratios(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prices = ",".join(["0.1", "0.3"] * 8)
    words = ["grid.size=4", f"cost.sensor=[{prices}]", "cost.safe=0", "resolution=0.01"]
    assert main(["frontier", *words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    content = report(tmp_path / "a")
    assert content["equal_prices"] is False
    assert "sensors by price" in capsys.readouterr().out
    cheap = tm.frontier(tm.make_world(size=4, cost=[1.0, 3.0] * 8, safe_cost=0), resolution=0.01)
    assert content["corners"][3]["sensors_per_step"] == pytest.approx(cheap.corners[3].sensors)


def test_ctrl_c_saves_the_corners_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def show(progress: FrontierProgress) -> None:
        if progress.corners == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(command, "reporting", lambda *_: nullcontext(show))
    assert main(["frontier", *SMALL, f"hydra.run.dir={tmp_path / 'a'}"]) == 130
    captured = capsys.readouterr()
    assert captured.err == "trackmdp frontier: interrupted\n"
    assert "interrupted: no policy is more than " in captured.out
    content = report(tmp_path / "a")
    assert (content["interrupted"], len(content["corners"])) == (True, 4)
    assert len(rows(tmp_path / "a")) == 4


def test_an_accuracy_that_no_policy_has_is_refused_after_the_files_are_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["sensor=miss", "sensor.p_d=0.5", "sensor.p_s=0.5", "grid.size=3", "accuracy=0.9"]
    words += ["resolution=0.05", "quiet=true", f"hydra.run.dir={tmp_path / 'a'}"]
    assert main(["frontier", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "trackmdp frontier: accuracy=0.9: expected a number from 0 to 0.5\n"
    assert report(tmp_path / "a")["corners"]


@pytest.mark.parametrize(
    ("word", "named"),
    [
        ("accuracy=1.5", "accuracy=1.5: expected a number from 0 to 1"),
        ("accuracy=much", "accuracy=much: expected"),
        ("sensors=-1", "sensors=-1: expected a number >= 0"),
        ("resolution=0", "resolution=0: expected a number > 0"),
        ("acuracy=0.9", "acuracy: unknown option, did you mean accuracy?"),
        ("solver=qmpd", "solver=qmpd: expected one of"),
        ("grid.max_steps=9", "grid.max_steps=9: expected null"),
        ("sensor=false_alarm", "sensor=false_alarm: expected"),
    ],
)
@pytest.mark.usefixtures("empty_folder")
def test_bad_values_are_refused_in_a_line(
    word: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert refused(capsys, "frontier", word).startswith(named)


@pytest.mark.usefixtures("empty_folder")
def test_a_price_that_nothing_reads_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "frontier", "cost.sensor=0.2", "cost.safe=0")
    assert line.startswith("cost.sensor=0.2: without effect")


def test_typed_in_a_shell(empty_folder: Path) -> None:
    result = typed("frontier", "grid.size=3", "sensors=1", "hydra.run.dir=here")
    assert (result.returncode, result.stderr) == (0, "")
    assert "frontier optimal on a 3x3 grid" in result.stdout
    assert (empty_folder / "here" / "frontier.csv").is_file()


def test_the_figure_shows_the_corners_and_what_was_asked_for(tmp_path: Path) -> None:
    words = ["accuracy=0.95", "quiet=true"]
    for name in ("a", "b"):
        assert main(["frontier", *SMALL, *words, f"hydra.run.dir={tmp_path / name}"]) == 0
    drawn = (tmp_path / "a" / "frontier.svg").read_text(encoding="utf-8")
    assert all(f">{text}<" in drawn for text in ("accuracy", "sensors per step", "accuracy=0.95"))
    # D = 0 and all certified: neither net accuracy nor bound is another line.
    assert "net accuracy" not in drawn
    assert "bound" not in drawn
    for name in ("frontier.svg", "frontier.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.usefixtures("little_search")
def test_the_figure_shows_net_accuracy_and_an_open_bound(tmp_path: Path) -> None:
    words = ["kernel=heading", "grid.size=3", "resolution=0.5", "quiet=true"]
    assert main(["frontier", *words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    drawn = (tmp_path / "a" / "frontier.svg").read_text(encoding="utf-8")
    assert ">net accuracy<" in drawn
    assert ">bound on all policies<" in drawn


def test_without_matplotlib_there_is_no_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "find_spec", lambda _: None)
    earlier, own = tmp_path / "a/corners/99/sets.json", tmp_path / "a/corners/98/notes"
    for file in (earlier, own):
        file.parent.mkdir(parents=True)
        file.write_text("of an earlier frontier, or of the user")
    assert main(["frontier", *SMALL, "quiet=true", f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    assert (earlier.parent.exists(), own.exists()) == (False, True)
    names = {file.name for file in (tmp_path / "a").iterdir()}
    assert names == {"frontier.csv", "frontier.json", "corners"}
