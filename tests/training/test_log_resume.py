"""The log of episodes of a run that is cut and goes on: the same bytes as if it never had been."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import later
from tests.training.runs import Killed, at_iteration, killed, train
from trackmdp.episodes.log import EpisodeLog
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.errors import RunError, UserError
from trackmdp.training import checkpoint
from trackmdp.training.run import load_run

LOGGED = (
    "log=[mcap]",
    "log.mcap.episodes=3",
    "log.mcap.evaluations=1",
    "evaluation.every=2",
    "kernel.exit_probability=0.2",
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was not cut."""
    folder = tmp_path_factory.mktemp("logged") / "whole"
    train(folder, *LOGGED)
    return folder


def cut(folder: Path, monkeypatch: pytest.MonkeyPatch, *, closes: bool, iteration: int = 6) -> None:
    """A run that ends once an iteration is recorded, before its checkpoint."""
    with monkeypatch.context() as patch, pytest.raises(Killed):
        if not closes:
            patch.setattr(
                EpisodeLog, "close", lambda self: self._writer.abandon()
            )  # the file stays as it is
        at_iteration(patch, iteration, killed)
        train(folder, *LOGGED)


def count(log: Path) -> int:
    with EpisodeReader(log) as reader:
        return len(reader)


@pytest.mark.parametrize("closes", [False, *later([True])])
def test_it_is_cut_back_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path, closes: bool
) -> None:
    cut(tmp_path / "cut", monkeypatch, closes=closes)
    left = tmp_path / "cut" / ("episodes.mcap" if closes else "episodes.mcap.part")
    assert left.is_file()
    train(tmp_path / "cut", *LOGGED, "resume=auto")
    logs = sorted(file.name for file in (tmp_path / "cut").glob("episodes*"))
    assert logs == ["episodes.mcap"]
    assert count(whole / "episodes.mcap") == 15
    assert load_run(tmp_path / "cut").columns[
        "iteration"
    ]  # its digests are those of the files at the end
    assert (tmp_path / "cut/episodes.mcap").read_bytes() == (whole / "episodes.mcap").read_bytes()


def test_a_kill_while_the_log_is_taken_over_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path
) -> None:
    cut(tmp_path / "cut", monkeypatch, closes=False)
    add, taken = EpisodeWriter.add, list[Any]()

    def fourth(self: EpisodeWriter, episode: Any) -> None:
        taken.append(episode)
        if len(taken) == 4:
            self.abandon()
            killed()
        add(self, episode)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(EpisodeWriter, "add", fourth)
        train(tmp_path / "cut", *LOGGED, "resume=auto")
    train(tmp_path / "cut", *LOGGED, "resume=auto")
    assert [file.name for file in (tmp_path / "cut").glob("episodes*")] == ["episodes.mcap"]
    assert (tmp_path / "cut/episodes.mcap").read_bytes() == (whole / "episodes.mcap").read_bytes()


@pytest.mark.parametrize("closes", [True, *later([False])])
def test_it_begins_anew_where_nothing_is_saved_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path, closes: bool
) -> None:
    cut(tmp_path / "cut", monkeypatch, closes=closes, iteration=1)
    assert (tmp_path / "cut/episodes.mcap.part").is_file()
    train(tmp_path / "cut", *LOGGED, "resume=auto")
    assert sorted(file.name for file in (tmp_path / "cut").glob("episodes*")) == ["episodes.mcap"]
    assert (tmp_path / "cut/episodes.mcap").read_bytes() == (whole / "episodes.mcap").read_bytes()


def test_a_log_that_was_taken_away_meanwhile_stays_and_another_is_begun_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(tmp_path / "cut", monkeypatch, closes=False, iteration=4)
    part = tmp_path / "cut/episodes.mcap.part"
    before = part.read_bytes()
    with monkeypatch.context() as patch, pytest.raises(Killed):
        at_iteration(patch, 6, killed)
        train(tmp_path / "cut", *LOGGED[3:], "log=[]", "resume=auto")
    train(tmp_path / "cut", *LOGGED, "resume=auto")
    assert part.read_bytes() == before
    assert count(tmp_path / "cut/episodes-2.mcap") == 6


def test_a_log_that_lost_episodes_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cut(tmp_path / "cut", monkeypatch, closes=False)
    part = tmp_path / "cut" / "episodes.mcap.part"
    short = part.read_bytes()[:4000]
    part.write_bytes(short)
    train(tmp_path / "cut", *LOGGED, "resume=auto")
    assert "not whole; a new log is begun beside it" in capsys.readouterr().err
    assert part.read_bytes() == short
    assert count(tmp_path / "cut" / "episodes-2.mcap") == 6


def test_on_a_full_disk_one_line_says_why_and_the_run_goes_on_as_if_it_never_had_been(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The log is over at iteration 2, the checkpoint after iteration 6 fails, and the same words go on later."""

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch, pytest.raises(RunError, match="No space left"):
        at_iteration(patch, 2, lambda: patch.setattr(EpisodeWriter, "add", full))
        at_iteration(patch, 6, full)
        train(tmp_path / "cut", *LOGGED)
    assert capsys.readouterr().err == ""
    train(tmp_path / "cut", *LOGGED, "resume=auto")
    mine, theirs = (
        checkpoint.load(checkpoint.newest(run))["callbacks"] for run in (tmp_path / "cut", whole)
    )
    assert mine["episodes"] == theirs["episodes"] == {"policies": 5}


@pytest.mark.parametrize(
    ("place", "error"),
    [("of", UserError("too large")), ("add", ValueError("NaN")), ("flush", MemoryError("none"))],
)
def test_a_log_that_cannot_be_written_never_ends_a_run(
    place: str,
    error: Exception,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(EpisodeWriter, place, broken)
    train(tmp_path / "run", *LOGGED)
    (line,) = capsys.readouterr().err.splitlines()
    assert f"episodes.mcap.part: {error}" in line
    assert (tmp_path / "run" / "summary.json").is_file()


def test_what_a_checkpoint_counts_on_is_on_the_disk_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power failure the bytes are gone that no fsync has put on the disk."""
    synced: dict[int, int] = {}
    fsync, point = os.fsync, checkpoint.point

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        synced[os.fstat(descriptor).st_ino] = os.fstat(descriptor).st_size

    def checked(file: Path, *, best: bool) -> None:
        state = checkpoint.load(file)["callbacks"]
        metrics, log = (tmp_path / name for name in ("metrics.csv", "episodes.mcap.part"))
        assert synced[metrics.stat().st_ino] >= state["csv"]["position"] > 0
        assert synced[log.stat().st_ino] == log.stat().st_size
        point(file, best=best)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(checkpoint, "point", checked)
    train(tmp_path, *LOGGED)
