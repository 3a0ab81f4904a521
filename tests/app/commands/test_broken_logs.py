"""Logs that were changed or cut off: `replay` verifies and recovers them, and the command that writes one goes on."""

from __future__ import annotations

import dataclasses
import errno
import os
import resource
import shlex
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.app.commands.test_replay import LOGGED, TRAIN, WORLD, log, replay
from trackmdp.app.cli import main
from trackmdp.episodes import schema
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.schema import TABLES
from trackmdp.episodes.writer import EpisodeWriter

__all__ = ["log"]


def changed(
    log: Path, target: Path, change: Callable[[Episode], Episode], run: dict[str, str] | None = None
) -> Path:
    """The log with episode 4 changed, all checksums right."""
    with EpisodeReader(log) as reader:
        tables = {name: reader.attachment(name) for name in TABLES}
        writer = EpisodeWriter(target, reader.said | (run or {}), tables)
        facts = {key: value for key, value in reader.policies[0].items() if key != "table.sha256"}
        writer.copy_policy(facts, reader.policy_tables(0))
        for episode in reader.episodes():
            writer.add(change(episode) if episode.number == 4 else episode)
    return writer.finish()


def test_verify_names_the_first_difference(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def dearer(episode: Episode) -> Episode:
        reward = episode.reward.copy()
        reward[2] = np.nextafter(reward[2], np.float32(9))
        return dataclasses.replace(episode, reward=reward)

    file = changed(log, tmp_path / "a.mcap", dearer)
    status, said, error = replay(capsys, f"file={file}", "verify=true")
    assert (status, said) == (1, "")
    assert error.startswith(f"trackmdp replay: file={file}: episode 4, step 2, reward: logged ")
    assert len(error.splitlines()) == 1
    assert replay(capsys, f"file={file}", "verify=true", "episode=3")[0] == 0


def test_logs_of_other_versions_are_told_and_may_differ_in_belief_only(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def believed(by: float) -> Callable[[Episode], Episode]:
        return lambda episode: dataclasses.replace(episode, belief=episode.belief + np.float32(by))

    other = {"torch": "2.12.0", "trackmdp": "0.0.1"}
    file = changed(log, tmp_path / "a.mcap", believed(1e-7), other)
    status, said, _ = replay(capsys, f"file={file}", "verify=true")
    assert status == 0
    told = schema.versions()
    assert said.splitlines()[0] == (
        f"made by other versions: trackmdp 0.0.1 (here {told['trackmdp']}), torch 2.12.0 (here {told['torch']})"
    )
    file = changed(log, tmp_path / "b.mcap", believed(1e-3), other)
    status, _, error = replay(capsys, f"file={file}", "verify=true")
    assert (
        status,
        "belief of cell" in error,
        "made by other versions: trackmdp 0.0.1" in error,
    ) == (1, True, True)


def test_recover_as_typed(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    part = tmp_path / "episodes.mcap.part"
    part.write_bytes(log.read_bytes()[:-1000])
    assert "recover=true saves every whole episode" in replay(capsys, f"file={part}")[2]
    status, said, _ = replay(capsys, f"file={part}", "recover=true", "verify=true")
    assert (status, said.splitlines()[0]) == (
        0,
        f"30 episodes -> {tmp_path}/episodes.recovered.mcap",
    )
    assert "the same to the bit" in said


def test_a_full_disk_stops_the_log_and_is_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    added = EpisodeWriter.add

    def full(writer: EpisodeWriter, episode: Episode) -> None:
        if episode.number >= 6:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        added(writer, episode)

    monkeypatch.setattr(EpisodeWriter, "add", full)
    words = [
        "train",
        *TRAIN,
        "evaluation.every=2",
        "log=[mcap]",
        "log.mcap.evaluations=1",
        "log.mcap.episodes=4",
        "quiet=true",
    ]
    assert main([*words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    part = tmp_path / "a/episodes.mcap.part"
    error = capsys.readouterr().err
    assert (
        error == f"trackmdp train: {part}: no space left on device; no more episodes are logged\n"
    )
    assert (tmp_path / "a/summary.json").is_file()
    assert part.is_file()
    assert not (tmp_path / "a/episodes.mcap").exists()


@pytest.mark.parametrize("step", ["add", "finish"])
def test_recovering_to_a_full_disk_is_one_line_and_leaves_nothing(
    step: str,
    log: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    writers: list[EpisodeWriter] = []

    def full(writer: EpisodeWriter, *_: Episode) -> None:
        writers.append(writer)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    file = tmp_path / "a.mcap"
    shutil.copy(log, file)
    monkeypatch.setattr(EpisodeWriter, step, full)
    assert main(["replay", f"file={file}", "recover=true"]) == 1
    target = tmp_path / "a.recovered.mcap"
    assert capsys.readouterr().err == f"trackmdp replay: {target}: No space left on device\n"
    assert list(tmp_path.iterdir()) == [file]
    with pytest.raises(ValueError, match="closed file"):
        writers[0].sync()


def test_an_evaluation_outlives_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(writer: EpisodeWriter) -> Path:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(EpisodeWriter, "finish", full)
    words = [
        "evaluate",
        "baseline=qmdp",
        *WORLD,
        "log=[mcap]",
        "episodes=5",
        f"hydra.run.dir={tmp_path}",
    ]
    assert main(words) == 0
    said = capsys.readouterr()
    assert said.err.endswith("no space left on device; no more episodes are logged\n")
    assert "episodes in " not in said.out
    assert (tmp_path / "evaluation.json").is_file()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_logging_names_the_part_and_how_to_save_it(
    number: signal.Signals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stopped(writer: EpisodeWriter) -> Path:
        signal.raise_signal(number)
        raise AssertionError

    words = [*LOGGED, f"hydra.run.dir={tmp_path / 'my runs'}"]
    with monkeypatch.context() as patch:
        patch.setattr(EpisodeWriter, "finish", stopped)
        assert main(words) == 128 + number
    said, *last = capsys.readouterr().err.splitlines()
    why = "interrupted" if number is signal.SIGINT else "stopped by signal 15"
    assert last == [f"trackmdp evaluate: {why}"]
    part = tmp_path / "my runs" / "episodes.mcap.part"
    assert said.startswith(f"trackmdp evaluate: {part}: cut off")
    assert main(shlex.split(said.split("`")[1])[1:]) == 0
    assert "30 episodes" in capsys.readouterr().out


def test_a_file_that_may_not_grow_leaves_what_was_flushed(log: Path, tmp_path: Path) -> None:
    from trackmdp.episodes.recover import recover

    with EpisodeReader(log) as reader:
        world, policy = reader.world(), reader.policy(0)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    said: list[str] = []
    mine = EpisodeLog(tmp_path, world, seed=0, config="", layout=False, tell=said.append)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        for _ in range(3):
            mine.record(policy, {}, 300)
        mine.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert said == [f"{tmp_path}/episodes.mcap.part: file too large; no more episodes are logged"]
    assert 0 < recover(tmp_path / "episodes.mcap.part").episodes < 300
