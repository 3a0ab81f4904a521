"""Back to a named checkpoint: what the course that was left had later is gone, wherever that is cut."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest

from tests.training.runs import Killed, assert_same_run, at_iteration, breaks, killed, rows, train
from trackmdp.errors import Preempted, RunError
from trackmdp.training import checkpoint
from trackmdp.training.loggers import CsvLogger
from trackmdp.training.state import Checkpoints

KEEP = "checkpoint.keep=3"


def broken(folder: Path, patch: pytest.MonkeyPatch, iteration: int, *words: str) -> Path:
    """A run that breaks down in this iteration; returns its folder of checkpoints."""
    with patch.context() as inner, pytest.raises(RunError):
        at_iteration(inner, iteration, breaks)
        train(folder, KEEP, *words)
    return folder / "checkpoints"


def test_later_checkpoints_are_not_gone_on_from(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    chosen = broken(folder, monkeypatch, 5) / "iteration-00000003.pt"
    assert checkpoint.newest(folder) > chosen
    broken(folder, monkeypatch, 4, f"resume={chosen}")
    assert checkpoint.newest(folder) == chosen
    train(folder, KEEP, "resume=auto")
    assert_same_run(folder, whole)


def test_a_kill_once_the_later_rows_are_cut_off_costs_nothing(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, start = tmp_path / "run", CsvLogger.on_start
    chosen = broken(folder, monkeypatch, 5) / "iteration-00000003.pt"

    def cut(self: CsvLogger, trainer: Any) -> None:
        start(self, trainer)
        self._file.close()
        killed()

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(CsvLogger, "on_start", cut)
        train(folder, KEEP, f"resume={chosen}")
    train(folder, KEEP, "resume=auto")
    assert_same_run(folder, whole)


def test_the_best_of_the_course_that_was_left_is_not_the_best(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fourth was the best; back to the third, of which the first, long removed, was the best so far."""
    folder, figures = tmp_path / "run", {1: 1e9, 2: 0.0, 3: 0.0, 4: 2e9}
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "_attained", lambda _, run: figures[run.position.iteration])
        place = broken(folder, monkeypatch, 5, "evaluation.every=1")
    best = place / checkpoint.BEST
    assert checkpoint.load(best)["iteration"] == 4
    # The second time, best.pt is the third already.
    for resume in (f"resume={place / 'iteration-00000003.pt'}", "resume=auto"):
        broken(folder, monkeypatch, 4, "evaluation.every=1", resume)
        assert checkpoint.load(best)["iteration"] == 3
    train(folder, KEEP, "evaluation.every=1", "resume=auto")
    judged = {int(row["iteration"]): float(row["aihtr"]) for row in rows(folder)[2:]}
    first = max(judged, key=lambda iteration: judged[iteration])
    assert checkpoint.load(best)["iteration"] == first
    state = checkpoint.load(place / checkpoint.LAST)
    assert state["callbacks"]["checkpoints"]["best"] == judged[first]


def test_no_best_is_left_where_no_checkpoint_counts_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, words = tmp_path / "run", ("checkpoint.every=512", "resume=auto")
    with monkeypatch.context() as patch, pytest.raises(Preempted):
        at_iteration(patch, 1, lambda: signal.raise_signal(signal.SIGTERM))
        train(folder, KEEP, *words)
    place = broken(folder, monkeypatch, 4, *words)
    assert (place / checkpoint.BEST).is_file()
    broken(folder, monkeypatch, 2, words[0], f"resume={place / 'iteration-00000001.pt'}")
    assert not (place / checkpoint.BEST).exists()
