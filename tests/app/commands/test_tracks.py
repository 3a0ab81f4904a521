"""`kernel=tracks` as a user types it: train, evaluate, export, resume."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.config.cases import composed
from tests.helpers import headings, later, small_world
from tests.reads import record_reads, unread
from tests.tracks import digest_of, drawn, write
from tests.training.runs import assert_same_run, at_iteration
from trackmdp.app.cli import main
from trackmdp.app.commands.train import run
from trackmdp.config.compose import compose
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.recordings.tracks import Recorded, read_tracks, split
from trackmdp.training.notices import poor
from trackmdp.training.train import train as train_in_python
from trackmdp.world.make import load_tracks
from trackmdp.world.problem_file import PROBLEM, read_problem

TRACKS = drawn(small_world(exit_probability=0.05).kernel, 60)
WORDS = [
    "kernel=tracks",
    "kernel.path=../tracks.csv",
    "kernel.min_length=1",
    "grid.size=3",
    "quiet=true",
]
SMALL = [
    "collector.total_frames=2048",
    "collector.frames_per_batch=256",
    "collector.envs=32",
    "evaluation.every=4",
    "checkpoint.every=256",
    "checkpoint.seconds=null",
]
CITY = Path(__file__).parents[2] / "data" / "city.csv"
LEARN = [
    "algo=hindsight",
    "algo.hidden=16",
    "algo.batch_size=64",
    "algo.updates=8",
    "algo.updates_per_iteration=2",
]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to type in, beside `tracks.csv`."""
    write(tmp_path / "tracks.csv", TRACKS)
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    return here


def train(run: str, *words: str) -> int:
    return main(["train", *WORDS, *SMALL, *LEARN, f"hydra.run.dir={run}", *words])


def test_train_then_evaluate_then_export(folder: Path) -> None:
    assert train("a") == 0
    summary = json.loads((folder / "a/summary.json").read_text())
    assert main(["evaluate", "run=a", "quiet=true"]) == 0
    evaluation = json.loads((folder / "a/evaluation.json").read_text())
    assert evaluation["held_out"] == summary["held_out"]
    assert evaluation["regret_per_step"] is None
    assert len(evaluation["value"]) == 9
    assert (
        "●" in (folder / "a/picture.txt").read_text()
        or "○" in (folder / "a/picture.txt").read_text()
    )
    written = json.loads((folder / "a/sets.json").read_text())
    assert main(["export", "run=a", "format=sets", "quiet=true"]) == 0
    assert json.loads((folder / "a/sets.json").read_text()) == written


def test_episodes_along_held_out_tracks_are_logged_replayed_and_shown(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["baseline=all_on", "log=[mcap]", "log.mcap.layout=true", "episodes=5"]
    assert main(["evaluate", *WORDS, *words, "hydra.run.dir=p", "quiet=false"]) == 0
    assert "5 episodes along held-out tracks in " in capsys.readouterr().out
    log = "file=p/episodes.mcap"
    assert main(["replay", log, "verify=true"]) == 0
    assert main(["replay", log, "episode=0", "html=a.html", "csv=t"]) == 0
    assert "along held-out tracks" in (folder / "a.html").read_text()
    assert len((folder / "t/episodes.csv").read_text().splitlines()) == 2
    capsys.readouterr()
    assert main(["replay", log, "episode=0"]) == 0
    assert capsys.readouterr().out.startswith("step 1 of ")


def test_a_training_logs_episodes_along_the_validation_tracks(folder: Path) -> None:
    assert train("a", "log=[mcap]") == 0
    setting = read_problem(folder / "a" / PROBLEM)
    assert isinstance(setting, Recorded)
    with EpisodeReader(folder / "a/episodes.mcap") as reader:
        found = reader.world()
        assert isinstance(found, Recorded)
        assert digest_of(found.held_out) == digest_of(setting.validation)


def test_the_picture_follows_a_held_out_track(folder: Path) -> None:
    assert main(["evaluate", *WORDS, "baseline=all_on", "hydra.run.dir=p", "seed=2"]) == 0
    lines = (folder / "p/picture.txt").read_text().splitlines()
    rows = [line.split("   ") for line in lines[1:4]]
    drawn_cells = [
        row * 3 + frame[row].split().index("●")
        for frame in zip(*rows, strict=True)
        for row in range(3)
        if "●" in frame[row]
    ]
    held_out = split(read_tracks(folder.parent / "tracks.csv", 3, exits=True), 0.2, 0.1, 0)[2]
    paths = [
        held_out.cells[a:b].tolist()
        for a, b in zip(held_out.first[:-1], held_out.first[1:], strict=True)
    ]
    assert any(path[1:7] == drawn_cells for path in paths)


@pytest.mark.parametrize(
    ("baseline", "sensors"), [("all_on", 9.0), ("none", 0.0), ("random_k", 2.0)]
)
def test_what_needs_no_motion_model_is_judged(baseline: str, sensors: float, folder: Path) -> None:
    words = ["baseline.k=2"] if baseline == "random_k" else []
    (folder / "b").mkdir()
    (folder / "b/sets.json").write_text("of another policy")
    assert main(["evaluate", *WORDS, f"baseline={baseline}", "hydra.run.dir=b", *words]) == 0
    figures = json.loads((folder / "b/evaluation.json").read_text())["held_out"]["figures"]
    free = (
        1.0
        if baseline == "all_on"
        else figures["policy"]["sensors_per_step"]["mean"] / sensors
        if sensors
        else 1.0
    )
    assert 0 < free <= 1  # the safe action's sensors are not counted
    if baseline == "all_on":
        assert figures["policy"] == figures["all on"]
    assert (folder / "b/sets.json").exists() == (baseline != "random_k")


def test_the_table_shows_what_can_be_judged(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("a", "quiet=false") == 0
    shown = capsys.readouterr().out
    for words in (
        "12 held-out tracks",
        "learned (hindsight)",
        "all on",
        "no sensors",
        "Q_MDP of the estimated kernel",
    ):
        assert words in shown
    assert "nan" not in shown
    assert "gap" not in shown
    assert "optimum" not in shown


def test_a_run_goes_on_with_its_own_tracks(folder: Path) -> None:
    assert train("whole") == 0
    with pytest.MonkeyPatch.context() as patch:
        at_iteration(patch, 5, lambda: (_ for _ in ()).throw(KeyboardInterrupt()))
        assert train("a") != 0
    assert not (folder / "a/summary.json").exists()
    write(folder.parent / "tracks.csv", replace(TRACKS, cells=8 - TRACKS.cells))
    assert train("a", "resume=auto") == 0
    assert_same_run(folder / "whole", folder / "a")
    whole, cut = (
        json.loads((folder / name / "summary.json").read_text()) for name in ("whole", "a")
    )
    assert whole["held_out"] == cut["held_out"]


@pytest.mark.parametrize(("ends", "starts"), [("exit", "anywhere"), ("cut", "first")])
def test_ends_and_starts_are_options(ends: str, starts: str, folder: Path) -> None:
    write(folder.parent / "tracks.csv", TRACKS.select(TRACKS.lengths > 1))
    assert train("a", f"kernel.ends={ends}", f"kernel.starts={starts}", "algo.updates=2") == 0
    summary = json.loads((folder / "a/summary.json").read_text())
    length = summary["policy"]["expected_length"]
    held_out = split(read_tracks(folder.parent / "tracks.csv", 3, exits=True), 0.2, 0.1, 0)[2]
    assert length == pytest.approx(held_out.lengths.mean() - (ends == "cut"))


@pytest.mark.parametrize("collector", later(["multi_sync", "multi_async"]))
def test_workers_replay_tracks_too(collector: str, folder: Path) -> None:
    assert train("a", f"collector={collector}", "collector.workers=2") == 0
    assert json.loads((folder / "a/summary.json").read_text())["frames"] == 2048


POSITIONS = {
    "kernel.step": 5,
    "grid.cell": 60,
    "kernel.max_gap": 10,
    "grid.origin": [0, 0],
    "kernel.ends": "cut",
}


def test_positions_are_the_same_from_the_command_line_and_from_python(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same names, the same tracks; what was left out is said, and kept beside the run."""
    words = [f"{key}={str(value).replace(' ', '')}" for key, value in POSITIONS.items()]
    world = [
        "grid.size=[15,12]",
        "grid.t_max=1",
        "cost.sensor=0.1",
        f"kernel.path={CITY}",
        "kernel=tracks",
    ]
    assert main(["train", *world, *words, *SMALL, *LEARN, "hydra.run.dir=a"]) == 0
    own = {key.partition(".")[2]: value for key, value in POSITIONS.items()}
    tracks = load_tracks(CITY, (15, 12), t_max=1, cost=0.1, **own)
    written = read_problem(folder / "a" / PROBLEM)
    assert isinstance(written, Recorded)
    for name in ("tracks", "validation", "held_out"):
        assert digest_of(getattr(written, name)) == digest_of(getattr(tracks, name))
    assert written.loaded == tracks.loaded
    outside = tracks.loaded["steps outside of the grid"]
    assert outside > 0
    said = " ".join(capsys.readouterr().out.split())
    assert (
        f"loaded: 17,970 reports read, 719 targets, 17,970 steps, {outside:,} steps outside of the grid"
        in said
    )
    assert main(["evaluate", "run=a", "quiet=true"]) == 0
    evaluation = json.loads((folder / "a/evaluation.json").read_text())
    assert evaluation["held_out"] == json.loads((folder / "a/summary.json").read_text())["held_out"]


def test_positions_loaded_in_python_are_evaluated_from_the_command_line(folder: Path) -> None:
    """The run keeps the tracks, and what was left out of the file that they were read from."""
    tracks = load_tracks(CITY, (15, 12), t_max=1, cost=0.1, step=5, cell=60)
    words: dict[str, Any] = {
        "total_frames": 2048,
        "updates": 4,
        "hidden": 16,
        "collector.frames_per_batch": 256,
    }
    done = train_in_python(tracks, "hindsight", folder="a", **words, **{"collector.envs": 32})
    kept = read_problem(folder / "a" / PROBLEM)
    assert isinstance(kept, Recorded)
    assert kept.loaded == tracks.loaded != {}
    assert main(["evaluate", "run=a", "quiet=true"]) == 0
    assert (
        json.loads((folder / "a/evaluation.json").read_text())["held_out"]
        == done.summary["held_out"]
    )


def test_every_option_of_the_tracks_is_read(folder: Path) -> None:
    cfg = composed("train", *WORDS, *SMALL, *LEARN)
    cfg.kernel.path = "../tracks.csv"
    (folder / "a").mkdir()
    with record_reads(cfg) as reads:
        run(cfg, folder / "a")
    assert not {key for key in unread(cfg, reads) if key.startswith("kernel.")}


def test_the_default_price_of_a_search_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert train("a", "quiet=false", "cost.sensor=0.9") == 0
    assert "cost.safe: D = 8.1" in capsys.readouterr().out
    assert train("b", "quiet=false", "cost.safe=3") == 0
    assert "cost.safe" not in capsys.readouterr().out


def test_the_advice_for_a_policy_below_one_of_less_memory_is_that_memory() -> None:
    config = compose("train", {"task.memory": "displacement"})
    others = {"task.memory=cell": 2.0, "all on": -9.0}
    (line,) = poor(config, 1.0, others, float("nan"), small_world())
    assert line.endswith("more than the learned policy; try task.memory=cell")


@pytest.mark.parametrize("typed", ["algo", "collector"])
def test_the_advice_of_more_frames_is_about_the_option_that_is_in_force(typed: str) -> None:
    config = compose("train", {"algo": "a2c", f"{typed}.total_frames": 51200})
    (line,) = poor(config, 1.0, {"Q_MDP": 0.5}, 0.1, small_world())
    assert f"; try more {typed}.total_frames, algo=a2c_per_sensor or" in line


@pytest.mark.parametrize("algo", ["a2c_per_sensor", "hindsight"])
@pytest.mark.parametrize("memory", ["cell", "displacement"])
@pytest.mark.parametrize("hides", [True, False])
def test_credit_per_sensor_says_why_it_ends_below_the_best(
    algo: str, memory: str, *, hides: bool
) -> None:
    """Of hidden modes, or of a memory: from .01 per step in units of the reward, and where no optimum is known."""
    config = compose("train", {"algo": algo})
    task = (headings() if hides else small_world()).but(memory=memory, reward=2.0)
    single = algo == "a2c_per_sensor" and (hides or memory != "cell")
    lines = {regret: poor(config, 1.0, {"Q_MDP": 0.5}, regret, task) for regret in (0.019, 0.021)}
    assert lines[0.019] == []
    assert len(lines[0.021]) == single
    for line in [*lines[0.021], *poor(config, 1.0, {"all on": 0.5}, float("nan"), task)]:
        assert single
        assert "only pay together" in line
        assert line.endswith("algo=model_based")


def test_credit_per_sensor_of_hidden_modes_ends_with_a_hint(
    capsys: pytest.CaptureFixture[str],
) -> None:
    few = ["collector.total_frames=2000", "collector.frames_per_batch=1000", "algo.updates=4"]
    words = ["kernel=heading", "grid.size=3", "cost.sensor=0.01", "algo.hidden=8", *few]
    assert main(["train", "algo=dqn_per_sensor", *words, "hydra.run.dir=a"]) == 0
    assert "note: credit per sensor may miss" in capsys.readouterr().out


def test_a_policy_below_a_reference_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    few = ["algo=ppo", "algo.total_frames=256", "algo.frames_per_batch=256", "algo.envs=16"]
    assert main(["train", *few, "grid.size=4", "hydra.run.dir=a"]) == 0
    assert capsys.readouterr().out.split("warning: ")[1].startswith("Q_MDP earns ")
    assert main(["train", "grid.size=4", "hydra.run.dir=b"]) == 0
    assert "warning" not in capsys.readouterr().out
