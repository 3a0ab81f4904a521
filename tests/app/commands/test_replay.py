"""`log=[mcap]`, `replay` and `baseline=playback` as they are typed."""

from __future__ import annotations

import csv
import json
import os
import pty
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.config.cases import composed
from tests.reads import record_reads, unread
from trackmdp.app.cli import main
from trackmdp.app.prepare import Prepared
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.layouts import layout as layout_of
from trackmdp.episodes.player import Playing, frame
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.sentences import sentence
from trackmdp.episodes.simulate import resimulate
from trackmdp.policies.acting import Playback
from trackmdp.untrusted import parse_yaml

ROOT = Path(__file__).parents[3]
WORLD = ["grid.size=4", "kernel.exit_probability=0.05", "cost.sensor=0.3"]
TRAIN = [
    *WORLD,
    "algo=a2c",
    "collector.total_frames=4096",
    "collector.frames_per_batch=256",
    "collector.envs=32",
]
LOGGED = [
    "evaluate",
    "baseline=qmdp",
    *WORLD,
    "log=[mcap]",
    "log.mcap.layout=true",
    "episodes=30",
    "quiet=true",
]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "a"
    assert main([*LOGGED, "seed=3", f"hydra.run.dir={folder}"]) == 0
    return folder / "episodes.mcap"


def replay(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    status = main(["replay", *words])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_evaluate_logs_as_many_episodes_as_it_simulates(log: Path) -> None:
    with EpisodeReader(log) as reader:
        assert len(reader) == 30
        assert reader.said["seed"] == "3"
        assert parse_yaml(reader.attachment("config.yaml"), "")["grid"]["size"] == 4
    layout = json.loads((log.parent / "episodes.layout.json").read_text())
    maps = [panel for panel in layout["configById"].values() if "topics" in panel]
    shown = [
        [layer["colorField"] for layer in panel["topics"].values() if layer["visible"]]
        for panel in maps
    ]
    assert shown == [["belief", "active", "target"], ["policy", "target"]]
    # WORLD has 4 x 4 cells of side 1: seen from above the middle of what /part places, 1.2 times their height
    views = [panel["cameraState"] for panel in maps]
    assert {(*view["targetOffset"], view["distance"]) for view in views} == {(0, 0, 0, 4.8)}
    assert layout_of((4, 6))["configById"]["3D!belief"]["cameraState"]["distance"] == pytest.approx(
        1.2 * 6
    )


def test_simulated_figures_are_those_of_the_episodes_in_the_log(log: Path) -> None:
    said = json.loads((log.parent / "evaluation.json").read_text())["simulated"]
    with EpisodeReader(log) as reader:
        episodes, m = list(reader.episodes()), reader.world().num_cells
    lengths = np.array([len(episode) for episode in episodes])
    assert said["episodes"] == len(episodes)
    assert said["aihtr"]["mean"] == pytest.approx(
        np.mean([episode.returns[-1] for episode in episodes]), abs=1e-9
    )
    assert said["expected_length"]["mean"] == pytest.approx(lengths.mean())
    assert said["expected_length"]["standard_error"] == pytest.approx(
        lengths.std(ddof=1) / len(episodes) ** 0.5
    )
    in_grid = sum(int((episode.target < m).sum()) for episode in episodes)
    assert said["accuracy"]["mean"] == pytest.approx(
        sum(int(each.located.sum()) for each in episodes) / in_grid
    )


def test_the_same_seed_gives_the_same_file(log: Path, tmp_path: Path) -> None:
    assert main([*LOGGED, "seed=3", f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    assert (tmp_path / "a/episodes.mcap").read_bytes() == log.read_bytes()
    assert main([*LOGGED, "seed=4", f"hydra.run.dir={tmp_path / 'b'}"]) == 0
    assert (tmp_path / "b/episodes.mcap").read_bytes() != log.read_bytes()


@pytest.mark.parametrize("baseline", ["random_k", "clocked"])
def test_every_kind_of_policy_verifies(
    baseline: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "evaluate",
        f"baseline={baseline}",
        *WORLD,
        "grid.max_steps=20",
        "log=[mcap]",
        "episodes=15",
    ]
    assert main([*words, f"hydra.run.dir={tmp_path}"]) == 0
    assert ("sets in sets.json" in capsys.readouterr().out) == (baseline == "clocked")
    status, said, _ = replay(capsys, f"file={tmp_path}/episodes.mcap", "verify=true")
    assert (status, "15 episodes" in said, "the same to the bit" in said) == (0, True, True)


def test_training_logs_the_first_the_kth_and_the_last_evaluation(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "train",
        *TRAIN,
        "evaluation.every=2",
        "log=[mcap]",
        "log.mcap.evaluations=3",
        "log.mcap.episodes=4",
        "quiet=true",
    ]
    assert main([*words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    with EpisodeReader(tmp_path / "a/episodes.mcap") as reader:
        labels = [policy["label"] for policy in reader.policies]
        assert labels == [f"iteration {k}" for k in (1, 6, 12, 16)]
        assert [row["policy"] for row in reader.rows] == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4
        assert len({row["seed"] for row in reader.rows}) == 16
    assert replay(capsys, f"file={tmp_path}/a/episodes.mcap", "verify=true")[0] == 0
    assert len((tmp_path / "a/metrics.csv").read_text().splitlines()) == 17


def test_every_option_is_read(log: Path, tmp_path: Path) -> None:
    words = ("quiet=true", "log=[mcap]", "evaluation.every=2", "log.mcap.evaluations=1", *TRAIN)
    cfg = composed("train", *words)
    with record_reads(cfg) as reads:
        Prepared("train", cfg, tmp_path).run()
    assert {key for key in unread(cfg, reads) if key.startswith("log")} == set()
    cfg = composed("replay", f"file={log}", "quiet=true", "episode=2")
    with record_reads(cfg) as reads:
        Prepared("replay", cfg, tmp_path).run()
    assert unread(cfg, reads) == set()
    playback = ("baseline=playback", f"baseline.file={log}", *WORLD, "quiet=true", "episodes=5")
    for words in (playback, ("baseline=qmdp", "log=[mcap]", *WORLD, "quiet=true", "episodes=5")):
        cfg = composed("evaluate", *words)
        with record_reads(cfg) as reads:
            Prepared("evaluate", cfg, tmp_path).run()
        of_training = {"log.mcap.evaluations", "log.mcap.episodes"}
        of_several = {"targets.count", "targets.merge", "evaluation.width"}
        assert unread(cfg, reads) - of_training - of_several == set()


def test_listing_and_playing_as_plain_text(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, said, _ = replay(capsys, f"file={log}")
    assert (status, "30 episodes, " in said, "4x4 grid, T_max 1, seed 3" in said) == (0, True, True)
    with EpisodeReader(log) as reader:
        episode, task = reader.read(7), reader.world().task
    status, said, _ = replay(capsys, f"file={log}", "episode=7")
    assert status == 0
    assert said.count("┌") == len(episode)
    assert "\x1b" not in said
    for t in (0, len(episode) - 1):
        assert f"{sentence(episode, t, task)}\n{frame(episode, t, task)}\n" in said


def test_tables_hold_every_step(log: Path, tmp_path: Path) -> None:
    assert (
        main(
            ["replay", f"file={log}", f"csv={tmp_path}/t", f"html={tmp_path}/a.html", "quiet=true"]
        )
        == 0
    )
    with (tmp_path / "t/steps.csv").open() as stream, EpisodeReader(log) as reader:
        rows = list(csv.DictReader(stream))
        assert len(rows) == sum(row["length"] for row in reader.rows)
        mine = [row for row in rows if row["episode"] == "5"]
        episode = reader.read(5)
        assert [float(row["reward"]) for row in mine] == episode.reward.tolist()
        assert [row["active"] for row in mine] == [
            " ".join(map(str, np.flatnonzero(action))) for action in episode.action
        ]
    assert (tmp_path / "a.html").stat().st_size > 10_000


def test_tables_that_are_interrupted_leave_those_from_before(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["replay", f"file={log}", f"csv={tmp_path}/t", "quiet=true"]
    assert main(words) == 0
    before = {file: file.read_bytes() for file in (tmp_path / "t").iterdir()}
    read = EpisodeReader.read

    def interrupted(self: EpisodeReader, number: int) -> Any:
        if number == 5:
            raise KeyboardInterrupt
        return read(self, number)

    monkeypatch.setattr(EpisodeReader, "read", interrupted)
    assert main(words) == 130
    assert {file: file.read_bytes() for file in (tmp_path / "t").iterdir()} == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("file=none.mcap", "file={here}/none.mcap: no such file"),
        ("file={log} episode=999", "episode=999: {log} holds 30 episodes (0 to 29)"),
        (
            "file={log} html=no/such/a.html",
            "html={here}/no/such/a.html: cannot be written (no such file or directory)",
        ),
        ("", "file: missing, expected a file written with log=[mcap]"),
    ],
)
def test_mistakes_end_in_one_line(
    words: str,
    message: str,
    log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    status, said, error = replay(capsys, *words.format(log=log).split())
    assert (status, said, error) == (
        2,
        "",
        f"trackmdp replay: {message.format(log=log, here=tmp_path)}\n",
    )
    assert not list(tmp_path.iterdir())


def test_a_log_is_read_from_a_folder_that_cannot_be_written_to(
    log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "locked").mkdir()
    monkeypatch.chdir(tmp_path / "locked")
    # Permission bits do not bind root, who may run the tests.
    monkeypatch.setattr(os, "access", lambda path, _: Path(path).resolve() != Path.cwd())
    for words in ([], ["verify=true"], [f"html={tmp_path / 'x.html'}"]):
        status, _, error = replay(capsys, f"file={log}", *words)
        assert (status, error) == (0, "")
    assert (tmp_path / "x.html").is_file()
    assert main(["solve", "grid.size=3", "hydra.run.dir=."]) == 2
    assert "expected a folder that can be written to" in capsys.readouterr().err


def test_playback_issues_the_actions_again(log: Path, tmp_path: Path) -> None:
    words = [
        "evaluate",
        "baseline=playback",
        f"baseline.file={log}",
        "baseline.episode=6",
        *WORLD,
        "quiet=true",
    ]
    assert main([*words, "episodes=50", f"hydra.run.dir={tmp_path}"]) == 0
    said = json.loads((tmp_path / "evaluation.json").read_text())
    with EpisodeReader(log) as reader:
        episode = reader.read(6)
        actions = Playback(reader.world(), episode.action)
        (again,) = resimulate(reader.world(), actions, [episode.seed]).complete()
    assert first_difference(episode, again) is None
    assert said["return"] == said["logged_return"] == episode.returns[-1]
    assert said["simulated"]["episodes"] == 50


def test_playback_needs_a_grid_of_its_size(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "baseline=playback", f"baseline.file={log}", "grid.size=5", "quiet=true"]
    assert main([*words, f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert "recorded on 4 x 4 cells, expected grid.size of 5 x 5 cells" in capsys.readouterr().err


def test_keys_of_the_player() -> None:
    state = Playing(steps=5, speed=4)
    state.tick()
    assert (state.t, state.paused) == (1, False)
    for key, t in (
        ("\x1b[C", 2),
        ("\x1b[D", 1),
        ("l", 2),
        ("\x1b[F", 4),
        ("l", 4),
        ("\x1b[H", 0),
        ("h", 0),
    ):
        state.press(key)
        assert (state.t, state.paused) == (t, True), key
    state.tick()
    assert state.t == 0
    state.press(" ")
    for _ in range(9):
        state.tick()
    assert (state.t, state.paused) == (4, True)
    state.press(" ")
    assert (state.t, state.paused) == (0, False)
    state.press("+")
    assert state.speed == 8
    state.press("-")
    assert (state.speed, state.over) == (4, False)
    state.press("q")
    assert state.over


@pytest.mark.slow
def test_playing_at_a_terminal(log: Path) -> None:
    """In a terminal of its own: the first step is drawn, an arrow steps on, q ends it."""
    ours, theirs = pty.openpty()
    words = [
        sys.executable,
        "-m",
        "trackmdp.app.cli",
        "replay",
        f"file={log}",
        "episode=7",
        "speed=0.01",
    ]
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "TERM": "xterm-256color",
        "COLUMNS": "120",
        "LINES": "40",
    }
    process = subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    shown = b""
    for wanted, key in ((b"step 1 of", b"\x1b[C"), (b"step 2 of", b"q")):
        while wanted not in shown:
            shown += os.read(ours, 4096)
        os.write(ours, key)
    try:
        while os.read(ours, 4096):
            pass
    except OSError:  # the other end is closed
        pass
    assert process.wait() == 0
    os.close(ours)
