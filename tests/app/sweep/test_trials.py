"""Sweeps that Optuna searches: what is asked for, what is kept, how the study goes on."""

from __future__ import annotations

import importlib.util
import inspect
import shutil
import signal
import sqlite3
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.app.sweep.runs import TINY, here, runs_of, states, swept, table
from tests.helpers import later
from tests.typed import stub
from trackmdp.app.cli import main
from trackmdp.errors import Preempted, adding
from trackmdp.training.folders import run_of

__all__ = ["here"]

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("optuna") is None, reason="optuna is not installed"
    ),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:sqlalchemy"),
]
SEARCH = (
    "algo=hindsight",
    "algo.gamma=interval(0.5,0.9)",
    "algo.batch_size=range(8,65,8)",
    "algo.hidden=8,16",
)


def searched(*words: str, dir: str = "all") -> int:
    return swept("hydra/sweeper=optuna", "quiet=true", *SEARCH, *words, dir=dir)


def peak(cfg: Any, folder: Path) -> float:
    """Stands for training: best at gamma 0.7, batch size 32 and 16 hidden units."""
    return float(
        -((cfg.algo.gamma - 0.7) ** 2) - abs(cfg.algo.batch_size - 32) / 100 + cfg.algo.hidden
    )


def trials(folder: Path) -> list[tuple[float, int, int, float]]:
    keys = ("algo.gamma", "algo.batch_size", "algo.hidden", "aihtr")
    return [tuple(float(row[key] or "nan") for key in keys) for row in table(folder)]  # type: ignore[misc]


def test_words_with_many_values_are_searched(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stub(monkeypatch, "train", peak)
    assert searched("hydra.sweeper.n_trials=4") == 0
    found = trials(here / "all")
    assert len(found) == 4
    assert all(
        0.5 <= gamma <= 0.9 and size % 8 == 0 and 8 <= size <= 64 for gamma, size, _, _ in found
    )
    assert {hidden for _, _, hidden, _ in found} == {8, 16}
    assert (here / "all/study.db").is_file()


def test_a_search_that_ends_early_lets_go_of_its_study(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Generator[Any, None, None]] = []

    def cut(*given: Any) -> int:
        begun.append(given[3])
        next(begun[0])
        raise Preempted(signal.SIGINT)

    monkeypatch.setattr("trackmdp.app.sweep.sweep.sweep", cut)
    assert searched("hydra.sweeper.n_trials=2") == 128 + signal.SIGINT
    assert inspect.getgeneratorstate(begun[0]) == inspect.GEN_CLOSED


def test_a_study_that_cannot_be_written_is_one_line(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def breaks(cfg: Any, folder: Path) -> float:
        with closing(sqlite3.connect(folder.parent / "study.db")) as study:
            study.execute("DROP TABLE trial_values")
        return peak(cfg, folder)

    stub(monkeypatch, "train", breaks)
    assert searched("hydra.sweeper.n_trials=2") == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "study.db: " in line
    assert "no such table: trial_values" in line


@pytest.mark.slow
def test_a_search_finds_better_runs_than_it_began_with(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub(monkeypatch, "train", peak)
    assert searched("hydra.sweeper.n_trials=30") == 0
    values = [value for *_, value in trials(here / "all")]
    assert sum(values[-10:]) / 10 > sum(values[:10]) / 10 + 1
    assert max(values) > 15.9


@pytest.mark.slow
def test_the_study_goes_on_to_the_number_asked_for(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stub(monkeypatch, "train", peak)
    for number in (3, 5, 5):
        assert searched(f"hydra.sweeper.n_trials={number}") == 0
        assert len(states(here / "all")) == number
    assert searched("hydra.sweeper.n_trials=5", dir="whole") == 0
    assert trials(here / "whole") == trials(here / "all")


@pytest.mark.slow
def test_a_finished_training_run_is_not_run_again_by_the_study(here: Path) -> None:
    assert (
        swept("hydra/sweeper=optuna", "quiet=true", "algo.hidden=8,16", "hydra.sweeper.n_trials=2")
        == 0
    )
    before = {
        run.folder: (run.folder / "summary.json").stat().st_mtime_ns
        for run in runs_of(here / "all")
    }
    assert (
        swept("hydra/sweeper=optuna", "quiet=true", "algo.hidden=8,16", "hydra.sweeper.n_trials=3")
        == 0
    )
    assert all(
        (folder / "summary.json").stat().st_mtime_ns == time for folder, time in before.items()
    )


@pytest.mark.slow
def test_a_failed_trial_is_told_and_tried_again_by_the_next_call(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(cfg: Any, folder: Path) -> float:
        if cfg.algo.hidden == 8:
            raise MemoryError
        return peak(cfg, folder)

    with monkeypatch.context() as patch:
        stub(patch, "train", fails)
        assert searched("hydra.sweeper.n_trials=6") == 1
    failed = [run.folder for run in runs_of(here / "all") if run.state == "failed"]
    assert 0 < len(failed) < 6
    stub(monkeypatch, "train", peak)
    assert searched("hydra.sweeper.n_trials=6") == 0
    assert all(run_of(folder).state == "done" for folder in failed)
    assert len(runs_of(here / "all")) == 6


def test_after_a_failed_trial_another_one_is_tried(here: Path) -> None:
    refused = ["cost.sensor=interval(-2,-1)", "hydra.sweeper.n_trials=3"]
    assert swept("hydra/sweeper=optuna", "quiet=true", *refused) == 2
    assert states(here / "all") == ["failed"] * 3


@pytest.mark.parametrize(
    "other",
    [
        ["grid.t_max=2"],  # another world
        [],  # the same, yet runs of the study were removed
        *later([["hydra.sweeper.objective=regret_per_step"]]),
    ],
)
def test_a_study_of_other_runs_does_not_go_on(
    other: list[str],
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stub(monkeypatch, "train", peak)
    assert searched("hydra.sweeper.n_trials=2") == 0
    if not other:
        shutil.rmtree(runs_of(here / "all")[0].folder)
    before = (here / "all/sweep.json").read_bytes()
    assert searched("hydra.sweeper.n_trials=3", *other) == 2
    assert "another search" in capsys.readouterr().err
    assert (here / "all/sweep.json").read_bytes() == before
    assert searched("hydra.sweeper.n_trials=1", "hydra.sweeper.study=anew", *other) == 0


def test_the_objective_may_be_the_regret(here: Path) -> None:
    words = [
        "hydra.sweeper.n_trials=2",
        "hydra.sweeper.objective=regret_per_step",
        "hydra.sweeper.sampler=random",
    ]
    assert swept("hydra/sweeper=optuna", "quiet=true", "algo.gamma=interval(0.5,0.9)", *words) == 0
    import optuna

    study = optuna.load_study(study_name="trackmdp", storage=f"sqlite:///{here / 'all/study.db'}")
    assert study.direction.name == "MINIMIZE"
    assert [trial.value for trial in study.trials] == [
        pytest.approx(float(row["regret_per_step"]), abs=1e-12) for row in table(here / "all")
    ]
    study._storage._backend.engine.dispose()  # type: ignore[attr-defined]


def test_mistakes(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    line = ["train", "-m", *TINY, "hydra/sweeper=optuna", "quiet=true", "hydra.sweep.dir=all"]
    for words, message in (
        (["seed=1"], "hydra/sweeper=optuna: expected a word to search"),
        (
            ["seed=1,2", "hydra.sweeper.storage=nowhere"],
            "hydra.sweeper.storage=nowhere: expected a data base's URL",
        ),
        (
            ["seed=1,2", "hydra.sweeper.n_trials=0"],
            "hydra.sweeper.n_trials=0: expected an integer >= 1 (runs)",
        ),
        (
            ["seed=1,2", "hydra.sweeper.objective=regret_per_step", "optimal.time_limit=9"],
            "optimal.time_limit: a regret",
        ),
        (["seed=interval(3,1)"], "seed=interval(3,1): expected interval(a,b) with a < b"),
        (
            ["algo.gamma=interval(0.9,nan)"],
            "algo.gamma=interval(0.9,nan): expected interval(a,b) with a < b",
        ),
        (
            ["algo.gamma=tag(log,interval(0,1))"],
            "algo.gamma=tag(log,interval(0,1)): expected interval(a,b) with 0 < a < b",
        ),
        (["seed=range(3,1)"], "seed=range(3,1): expected 1 to 100,000 values"),
        (
            ["seed=range(0,1000000000)"],
            "seed=range(0,1000000000): expected 1 to 100,000 values",
        ),
        (["algo.hiden=1,2"], "algo.hiden: unknown option, did you mean algo.hidden?"),
    ):
        assert main([*line, *words]) == 2
        assert capsys.readouterr().err.startswith(f"trackmdp train: {message}")
    stub(monkeypatch, "train", lambda cfg, folder: 1.0)
    assert main([*line, "algo.hidden=1,2", "hydra.sweeper.n_trials=1"]) == 0
    assert main([*line, "algo.hidden=3,4", "hydra.sweeper.n_trials=2"]) == 2
    assert "the study is one of another search" in capsys.readouterr().err
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main([*line, "seed=1,2"]) == 2
    assert capsys.readouterr().err.endswith(f"needs optuna, which {adding('optuna')} adds\n")
