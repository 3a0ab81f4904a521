"""Episodes of targets with a mode: beliefs, the log, and what is made of it."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers import later
from tests.typed import refused
from trackmdp.app.cli import main
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.episodes.sentences import mode_words
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.motion.modes import heading_kernel
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World

WORLD = ["kernel=heading", "grid.size=3", "kernel.exit_probability=0.1", "cost.sensor=0.2"]


def headings(**more: Any) -> World:
    kernel, modes = heading_kernel(3, keep=0.7, go=0.9, exit_probability=0.1)
    return World(kernel, 3, modes=modes, cost=0.2, t_max=1, **more)


def bayes(world: World, episode: Episode) -> list[np.ndarray]:
    """The belief over cells before each observation, by Bayes' rule on (cell, mode) written out."""
    cell, kernel, found = np.arange(72) // 8, world.kernel.toarray(), []
    told = world.revealed > 1
    belief = (
        (np.arange(72) == episode.start * 8 + episode.start_mode)
        if told
        else (cell == episode.start) / 8
    )
    assert episode.mode is not None
    for t in range(len(episode)):
        predicted = belief @ kernel
        found.append(np.bincount(cell, predicted, 9))
        if episode.located[t]:
            state = episode.target[t] * 8 + episode.mode[t]
            belief = (
                (np.arange(72) == state) * 1.0 if told else predicted * (cell == episode.target[t])
            )
        else:
            on = episode.action[t][cell] * world.detection[cell]
            belief = predicted * (1 - on)
        belief = belief / max(belief.sum(), 1e-300)
    return found


@pytest.mark.parametrize("more", [{}, {"revealed": 8}, {"detection": 0.7}], ids=str)
def test_the_belief_is_that_of_cell_and_mode(more: dict[str, Any]) -> None:
    """Followed through detections as well: two of them tell something of the heading."""
    world = headings(**more)
    sets = np.random.default_rng(1).random((9, 2, 9)) < 0.4
    policy = Policy.from_dense(world.remembering(), sets)
    for episode in simulate(world, policy, 5, seed=2).complete():
        assert episode.belief is not None
        assert episode.belief == pytest.approx(np.array(bayes(world, episode)), abs=1e-6)


def test_a_mode_is_told_by_its_mean_step() -> None:
    """Mode 0 goes one cell to the right, from two of three cells; 1 stays; 2 goes up a row in half its steps."""
    moves = np.zeros((2, 3, 3, 2, 3, 3))  # row, column, mode before and after
    for column in range(3):
        for row, before in np.ndindex(2, 3):
            moves[row, column, before, row, min(column + 1, 2), 0] = 0.3
            moves[row, column, before, row, column, 1] = 0.3
            moves[row, column, before, 0, column, 2] = 0.3
    world = World(moves.reshape(18, 18), (2, 3), modes=3, cost=0.1, t_max=1)
    assert world.drift == pytest.approx(np.array([[0, 2 / 3], [0, 0], [-1 / 2, 0]]))
    assert [mode_words(world, mode) for mode in range(3)] == [
        "mode 0 → 0.7 cells a step",
        "mode 1",
        "mode 2 ↑ 0.5 cells a step",
    ]
    assert [mode_words(headings(), mode)[7] for mode in range(8)] == list("→↗↑↖←↙↓↘")


def test_replay_and_page_show_the_mode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logged(tmp_path, "baseline=all_on").close()
    log = f"file={tmp_path}/episodes.mcap"
    assert main(["replay", log, "episode=0", f"html={tmp_path}/a.html"]) == 0
    capsys.readouterr()
    assert main(["replay", log, "episode=0"]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("step ")]
    with EpisodeReader(tmp_path / "episodes.mcap") as reader:
        episode, world = reader.read(0), reader.world()
    assert isinstance(world, World)
    assert episode.mode is not None
    assert [
        mode_words(world, mode) in line for line, mode in zip(said, episode.mode[:-1], strict=False)
    ] == [True] * (len(episode) - 1)
    assert "mode" not in said[-1]  # it has left
    found = re.search(
        r'<script id="data" type="application/json">(.*?)</script>',
        (tmp_path / "a.html").read_text(),
    )
    assert found
    data = json.loads(found[1])
    assert data["mode"] == episode.mode.tolist()
    assert data["drift"] == pytest.approx(world.drift, abs=5e-4)


def logged(folder: Path, *words: str) -> EpisodeReader:
    line = [
        "evaluate",
        *WORLD,
        *words,
        "log=[mcap]",
        "episodes=30",
        "quiet=true",
        f"hydra.run.dir={folder}",
    ]
    assert main(line) == 0
    return EpisodeReader(folder / "episodes.mcap")


@pytest.mark.usefixtures("little_search")
@pytest.mark.parametrize(
    "words",
    [
        ["baseline=optimal", "task.memory=displacement", "task.clip=1"],
        ["baseline=optimal", "kernel.reveals=true", "sensor=miss", "sensor.p_d=0.8"],
        *later([["baseline=all_on"]]),
    ],
    ids=["remembered", "told", "all_on"],
)
def test_a_log_resimulates_bit_for_bit(words: list[str], tmp_path: Path) -> None:
    """By the command line, twice: the same bytes, the modes among them, and every episode the same again."""
    with logged(tmp_path / "a", *words) as reader, logged(tmp_path / "b", *words) as again:
        assert (tmp_path / "a/episodes.mcap").read_bytes() == (
            tmp_path / "b/episodes.mcap"
        ).read_bytes()
        proved = verify(reader)
        assert (proved.episodes, proved.difference) == (30, None)
        world, episode = reader.world(), again.read(3)
        assert isinstance(world, World)
        assert (world.modes, world.revealed) == (8, 8 if "kernel.reveals=true" in words else 1)
        # One move apart: the logged modes and cells are those of the kernel.
        assert episode.mode is not None
        state = np.append(episode.start * 8 + episode.start_mode, episode.target * 8 + episode.mode)
        assert (world.kernel[state[:-2], state[1:-1]] > 0).all()
        assert (episode.mode[-1], episode.target[-1]) == (-1, 9)
    file = f"file={tmp_path}/a/episodes.mcap"
    outputs = [f"html={tmp_path}/p.html", f"csv={tmp_path}/tables", f"layout={tmp_path}/l.json"]
    assert main(["replay", file, "verify=true", "quiet=true", *outputs]) == 0
    with (tmp_path / "tables/steps.csv").open() as stream:
        modes = {int(row["mode"]) for row in csv.DictReader(stream)}
    assert modes == set(range(-1, 8))
    assert main(["replay", file, "episode=2", "quiet=true"]) == 0


@pytest.mark.usefixtures("little_search")
def test_a_cut_log_is_recovered_with_its_modes(tmp_path: Path) -> None:
    logged(tmp_path, "baseline=optimal").close()
    whole = (tmp_path / "episodes.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    saved = recover(tmp_path / "cut.mcap")
    with EpisodeReader(saved.file) as reader:
        assert 0 < len(reader) < 30
        assert verify(reader).difference is None


def test_a_mode_that_differs_is_named() -> None:
    world = headings()
    [episode] = simulate(world, Policy.all_on(world), 1, seed=4).complete()
    assert episode.mode is not None
    other = replace(
        episode, mode=np.where(np.arange(len(episode)) == 2, 7 - episode.mode, episode.mode)
    )
    assert first_difference(episode, episode) is None
    assert str(first_difference(episode, other)).startswith("step 2, mode: logged")
    assert str(first_difference(episode, replace(episode, start_mode=99))).startswith(
        "start_mode: logged"
    )


@pytest.mark.usefixtures("little_search")
def test_a_run_is_evaluated_and_its_episodes_logged(tmp_path: Path) -> None:
    """What training logged, and what `evaluate run=` says: the run's own figures, and episodes that replay."""
    words = [
        "algo=model_based",
        "algo.total_frames=1000",
        "collector.frames_per_batch=1000",
        "log=[mcap]",
        "quiet=true",
    ]
    memory = ["task.memory=displacement", "task.clip=1", "log.mcap.episodes=3"]
    assert main(["train", *WORLD, *words, *memory, f"hydra.run.dir={tmp_path}/run"]) == 0
    assert main(["replay", f"file={tmp_path}/run/episodes.mcap", "verify=true", "quiet=true"]) == 0
    line = [
        "evaluate",
        f"run={tmp_path}/run",
        "episodes=50",
        "quiet=true",
        f"hydra.run.dir={tmp_path}/judged",
    ]
    assert main([*line, "log=[mcap]"]) == 0
    judged = json.loads((tmp_path / "judged/evaluation.json").read_text())
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert judged["exact"]["aihtr"] == pytest.approx(summary["policy"]["aihtr"])
    assert judged["bounds"]["clocked"] == pytest.approx(summary["bounds"]["clocked"])
    with EpisodeReader(tmp_path / "judged/episodes.mcap") as reader:
        assert (reader.policy(0).task.memory, reader.policies[0]["memory"]) == (
            "displacement",
            "displacement",
        )
    # The sets that were written are a baseline, which remembers what they say.
    sets = [
        "baseline=sets",
        f"baseline.file={tmp_path}/judged/sets.json",
        "episodes=0",
        "quiet=true",
    ]
    assert main(["evaluate", *WORLD, *sets, f"hydra.run.dir={tmp_path}/sets"]) == 0
    again = json.loads((tmp_path / "sets/evaluation.json").read_text())
    assert again["exact"]["aihtr"] == pytest.approx(judged["exact"]["aihtr"])


def test_an_episode_is_played_back(tmp_path: Path) -> None:
    logged(tmp_path / "log", "baseline=optimal", "kernel.reveals=true").close()
    words = [
        "baseline=playback",
        f"baseline.file={tmp_path}/log/episodes.mcap",
        "baseline.episode=1",
        "episodes=10",
    ]
    line = [
        "evaluate",
        *WORLD,
        "kernel.reveals=true",
        *words,
        "quiet=true",
        f"hydra.run.dir={tmp_path}/played",
    ]
    assert main(line) == 0
    report = json.loads((tmp_path / "played/evaluation.json").read_text())
    assert report["return"] == report["logged_return"]


def test_sets_of_other_modes_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    sets = {
        "size": [3, 3],
        "t_max": 1,
        "memory": {"kind": "cell", "clip": 2, "classes": 2, "revealed": 2},
    }
    (tmp_path / "s.json").write_text(
        json.dumps(sets | {"sets": {str(key): [[], []] for key in range(18)}})
    )
    words = [
        *WORLD,
        "baseline=sets",
        f"baseline.file={tmp_path}/s.json",
        "quiet=true",
        f"hydra.run.dir={tmp_path}/run",
    ]
    told = refused(capsys, "evaluate", *words)
    assert told == "policy: made for targets with 2 modes; expected 8"
    many = {"kind": "cell", "clip": 2, "classes": 2, "revealed": 10**15}
    (tmp_path / "s.json").write_text(
        json.dumps({"size": [3, 3], "t_max": 1, "memory": many, "sets": {}})
    )
    told = refused(capsys, "evaluate", *words)
    assert "0 plans, t_max 1; expected 9000000000000000" in told
    with pytest.raises(UserError):
        Policy.from_dense(headings(revealed=8), np.zeros((9, 2, 9), dtype=bool))
