"""The examples run as they stand, are short, and print what they should."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from trackmdp.config.world import MEMORIES
from trackmdp.grid.place import Place
from trackmdp.policies.policy import Policy
from trackmdp.sensing.task import Task

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "scripts" / "examples"
SOURCES = sorted(EXAMPLES.rglob("*.py"))
PLUGIN = EXAMPLES / "plugin"


def numbers(line: str) -> list[float]:
    return [float(each) for each in re.findall(r"-?\d+\.\d+", line)]


def run(*words: str, path: tuple[Path, ...] = ()) -> list[str]:
    """The lines that a new process prints."""
    python_path = os.pathsep.join(str(each) for each in (*path, ROOT))
    environment = {**os.environ, "PYTHONPATH": python_path, "OMP_NUM_THREADS": "1"}
    # A command that ran in this process set it for its children; without it an example finds the modules beside it.
    environment.pop("PYTHONSAFEPATH", None)
    done = subprocess.run(
        [sys.executable, *words], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()


def example(name: str) -> list[str]:
    return run(str(EXAMPLES / f"{name}.py"))


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_an_example_is_short(source: Path) -> None:
    most = 150 if "trackmdp_stone_soup" in source.parts else 75
    assert len(source.read_text(encoding="utf-8").splitlines()) <= most


@pytest.mark.slow
def test_first_result() -> None:
    """Within .2 of the proved optimum of an episode of 125 steps, and three steps in a picture of 80 columns."""
    values, _, *picture = example("first_result")
    learned, best = numbers(values)
    assert best - 0.2 < learned <= best + 1e-9
    assert values.endswith("(proved: True)")
    assert picture[0].split() == ["step", "1", "step", "2", "step", "3"]
    assert len(picture) > 10 and max(map(len, picture)) < 80


@pytest.mark.slow
def test_own_kernel() -> None:
    """Learned from 20,000 steps, the policy is the optimum, which earns more than Q_MDP."""
    qmdp, learned, optimal, proved = (numbers(line) for line in example("own_kernel"))
    assert qmdp[0] < learned[0] == optimal[0] == proved[0]


@pytest.mark.slow
def test_own_policy() -> None:
    """The simulated value is the exact one, up to four standard errors."""
    exact, simulated, optimal = (numbers(line) for line in example("own_policy"))
    assert abs(exact[0] - simulated[0]) < 4 * simulated[1]
    assert exact[0] < optimal[0]


@pytest.mark.slow
def test_torchrl_ppo() -> None:
    """At 11.184 the optimum; all off gets -8.4."""
    ((drawing, learned, optimum),) = (numbers(line) for line in example("torchrl_ppo"))
    assert 0.85 * optimum < learned <= optimum + 1e-9
    assert drawing < learned


@pytest.mark.slow
def test_gymnasium_sb3() -> None:
    """Stable-Baselines3's PPO and A2C get most of the way from sensing nothing to the optimum."""
    pytest.importorskip("stable_baselines3")
    _, *lines = example("gymnasium_sb3")
    for learned, none, optimum in map(numbers, lines):
        assert none + 0.6 * (optimum - none) < learned <= optimum + 1e-9


@pytest.mark.slow
def test_stone_soup() -> None:
    """The same rewards on both sides; who is located more often is less far off."""
    pytest.importorskip("stonesoup", reason="needs the extra: pip install 'trackmdp[stonesoup]'")
    off, qmdp, optimal = (numbers(line) for line in example("stone_soup/compare"))
    assert all(ours == pytest.approx(theirs, abs=1e-4) for ours, theirs, *_ in (off, qmdp, optimal))
    assert off[0] < qmdp[0] < optimal[0]
    assert off[2] < qmdp[2] < optimal[2]
    assert off[3] > qmdp[3] > optimal[3]


@pytest.mark.slow
def test_stone_soup_of_several_targets() -> None:
    """With no sensors three targets are far off, also with a safe action in every third step."""
    pytest.importorskip("stonesoup", reason="needs the extra: pip install 'trackmdp[stonesoup]'")
    off, merged = (numbers(line) for line in example("stone_soup/several"))
    assert off[0] == 0 < merged[0] < 25
    assert off[1] < merged[1] <= 1
    assert off[2] > 3 * merged[2] > 0


@pytest.mark.slow
def test_own_tracks() -> None:
    loaded, *rows = example("own_tracks")
    assert loaded.startswith("17,970 reports read, 719 targets")
    learned, all_on, none, qmdp, keyed = (numbers(row.split("step")[1])[0] for row in rows)
    assert keyed > learned > max(all_on, none, qmdp)


def test_a_sweep_that_is_refused_ends_as_its_command_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", ["sweep.py", str(tmp_path / "file")])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLES / "sweep.py"), run_name="__main__")
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == "" and "hydra.sweep.dir=" in said.err and "report" not in said.err


@pytest.mark.slow
def test_sweep(tmp_path: Path) -> None:
    """The page holds the four runs, and a figure of them against the price."""
    *_, page = run(str(EXAMPLES / "sweep.py"), str(tmp_path / "sweep"))
    text = Path(page).read_text(encoding="utf-8")
    assert "4 of 4 planned runs" in text
    assert 'id="regret-z-3"' in text


@pytest.mark.slow
def test_the_plugin_learns_by_its_name(tmp_path: Path) -> None:
    """Installed, the algorithm is found by its name; what it learns is worth about as much as Q_MDP, and is loaded."""
    info = tmp_path / "trackmdp_counts-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: trackmdp-counts\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text("[trackmdp.plugins]\ncounts = trackmdp_counts\n")
    code = (
        "import trackmdp as tm; w = tm.make_world(size=5, cost=0.16); "
        f"run = tm.train(w, 'counts', seed=0, total_frames=50_000, prior=5, folder={str(tmp_path / 'run')!r}); "
        "from trackmdp.training.run import trained; loaded = trained(str(run.folder), 'cpu')[1]; "
        "print(run.evaluation.aihtr, tm.evaluate(w, loaded).aihtr, "
        "tm.evaluate(w, tm.solve(w, 'qmdp').policy).aihtr, tm.solve(w).upper)"
    )
    (line,) = run("-c", code, path=(PLUGIN, tmp_path))
    learned, loaded, qmdp, upper = numbers(line)
    assert 0.9 * qmdp < learned == loaded <= upper


@pytest.mark.slow
def test_a_tracker_is_driven_by_a_file_of_detections(tmp_path: Path) -> None:
    """Cells of 10 x and y on 3 x 3, y up; the sensor of the last located cell alone is on, T_max 1."""
    place = Place((0.0, 0.0), 10.0)
    task = Task(3, cost=0.1, t_max=1, place=place)
    table = np.eye(9, dtype=bool)[:, None].repeat(2, axis=1)
    Policy.from_dense(task, table).save(tmp_path / "policy.npz")
    lines = ["x,y", "5,5", "9,9", ",", "15,5", "15,6", "15,7", "40,5", "5,5"]
    # With the mark at the head that spreadsheets write.
    (tmp_path / "seen.csv").write_text("\n".join(lines) + "\n", encoding="utf-8-sig")
    words = (str(tmp_path / "policy.npz"), str(tmp_path / "seen.csv"))
    assert run(str(EXAMPLES / "tracker.py"), *words) == [
        "step 1: sensors 6: located in cell 6",
        "step 2: sensors 6: missed",
        "step 3: sensors 6: missed",
        "step 4: safe action: located in cell 7",
        "step 5: sensors 7: located in cell 7",
        "step 6: left the grid",
        "located in 3 of 5 steps, 4 sensors on, 1 safe actions",
    ]


@pytest.mark.parametrize(
    ("policy", "lines", "said"),
    [
        ("none.npz", ["x,y", "5,5"], "none.npz: no such file"),
        ("policy.npz", [], "No such file or directory: '.*seen.csv'"),
        ("policy.npz", ["x,y", "5,500"], "cell_of: x, y = 5, 500 is outside of the grid"),
        ("policy.npz", ["x,y", ","], r"seen.csv: line 2: \{'x': '', 'y': ''\}, expected x and y"),
        ("policy.npz", ["lat,long", "5,5"], "line 2: .*'long': '5'.*, expected lat and lon"),
        ("policy.npz", ["x,y", "5,5", "5"], "seen.csv: line 3: .*, expected x and y"),
        ("policy.npz", ["x,y"], r"seen.csv: line 2: \{\}, expected x and y"),
        ("policy.npz", ["x,y", "a,b"], "could not convert string to float: 'a'"),
        ("policy.npz", ["id,x,y", "1,5,5", "2,15,5"], "seen.csv: ids 1, 2, expected one target"),
    ],
)
def test_a_tracker_of_a_wrong_file_ends_in_a_line(
    policy: str, lines: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Policy.all_on(Task(3, cost=0.1, place=Place((0.0, 0.0), 10.0))).save(tmp_path / "policy.npz")
    if lines:
        (tmp_path / "seen.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    words = ["tracker.py", str(tmp_path / policy), str(tmp_path / "seen.csv")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit, match=rf"^tracker.py: .*{said}"):
        runpy.run_path(str(EXAMPLES / "tracker.py"), run_name="__main__")


@pytest.mark.slow
def test_a_tracker_follows_a_vehicle_that_was_held_out() -> None:
    *steps, figures = example("tracker")
    located, count, sensing, safe = map(int, re.findall(r"\d+", figures))
    assert count >= len(steps) - 1 > 10
    assert 0.5 * count < located <= count
    assert safe < count / 4
    assert sensing < 20 * count


@pytest.mark.slow
def test_remembering_the_displacement_pays_on_the_ring() -> None:
    """A vehicle that is known to go round one way: no sensor is on behind it."""
    lines = example("memory")
    known = {line.split()[0]: numbers(line)[0] for line in lines}
    assert list(known) == list(MEMORIES)
    assert min(known[memory] for memory in [*MEMORIES][1:]) > known["cell"] + 0.1
    (chosen,) = (
        line.split()[0] for line in lines if line.endswith(", the choice of the validation")
    )
    assert chosen != "cell"


@pytest.mark.slow
def test_storms_are_gridded_from_the_columns_of_ibtracs(tmp_path: Path) -> None:
    """Along a parallel, one degree a fix: half of the storms to the east over the date line, half to the west.

    A fix 12 h after the one before ends a storm, and one of five fixes is none.
    """
    lines = ["track_id,season,time,lon,lat"]
    for storm in range(40):
        way, fixes = 1 if storm % 2 else -1, 5 if storm == 0 else 14
        for fix in range(fixes):
            day, hour = divmod(6 * (fix + (fix > 11)), 24)
            lon = (178.5 + way * (fix - 7 + storm % 5) + 180) % 360 - 180
            lines.append(
                f"s{storm:02},2001,2001-01-{day + 1:02} {hour:02}:00:00,{lon},{12.5 - storm % 3}"
            )
    (tmp_path / "fixes.csv").write_text("\n".join(lines) + "\n")
    cells = tmp_path / "cells.csv"
    storms = runpy.run_path(str(EXAMPLES / "storms.py"))
    assert storms["gridded"](tmp_path / "fixes.csv", cells) == (3, 360)
    track, row, column = np.loadtxt(cells, delimiter=",", skiprows=1, dtype=int).T
    assert np.bincount(track).tolist() == [12] * 39
    assert row[:12].tolist() == [1] * 12
    assert column[:12].tolist() == list(range(172, 184))
    known = {
        line.split()[0]: numbers(line)[0]
        for line in run(str(EXAMPLES / "storms.py"), str(tmp_path / "fixes.csv"))
    }
    assert known["displacement"] > known["cell"] + 0.1


def test_storms_without_a_file_say_what_is_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["storms.py"])
    with pytest.raises(SystemExit, match="FILE is a CSV"):
        runpy.run_path(str(EXAMPLES / "storms.py"), run_name="__main__")
