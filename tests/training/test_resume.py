"""A run that is cut goes on as if nothing had happened: by the command line, in processes of their own."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from tests.training.runs import assert_same_run, rows
from trackmdp.training import checkpoint

RECIPES = {
    "ppo": ["algo=ppo"],
    "a2c": ["algo=a2c", "collector.envs=64"],
    "dqn": ["algo=dqn", "algo.buffer_size=20000", "algo.batch_size=128", "algo.updates=2"],
    "dqn-prioritized": [
        "algo=dqn",
        "algo.buffer_size=20000",
        "algo.batch_size=128",
        "algo.updates=2",
        "algo.n_step=3",
        "algo.prioritized.enabled=true",
    ],
    "hindsight-mixed": [
        "algo=hindsight",
        "algo.collect=mixed",
        "algo.updates=120",
        "algo.batch_size=1024",
        "algo.updates_per_iteration=4",
    ],
    "hindsight": [
        "algo=hindsight",
        "algo.updates=120",
        "algo.batch_size=1024",
        "algo.updates_per_iteration=4",
    ],
}
# Environment and replay buffer with sensors that miss; the joint learners know of them through the environment alone.
# As large grids are learned: tables in place of nets, and actions of the window's sensors alone.
RECIPES["hindsight-tables"] = [*RECIPES["hindsight"], "algo.hidden=0", "grid.window=1"]
RECIPES["hindsight-map"] = [*RECIPES["hindsight-tables"], "algo.share_cells={folder}/map.csv"]
# Policies that know more at a detection than the cell.
RECIPES["ppo-told"] = [*RECIPES["ppo"], "kernel=heading", "kernel.reveals=true"]
RECIPES["hindsight-told"] = [*RECIPES["hindsight"], "kernel=heading", "kernel.reveals=true"]
RECIPES["hindsight-memory"] = [*RECIPES["hindsight"], "kernel=heading", "task.memory=displacement"]
RECIPES["learned-told"] = ["algo=model_based", "kernel=heading", "kernel.reveals=true"]
RECIPES["dqn-memory"] = [*RECIPES["dqn"], "kernel=heading", "task.memory=displacement"]
RECIPES |= {
    f"{name}-miss": [*RECIPES[name], "sensor=miss", "sensor.p_d=.8"]
    for name in ("hindsight", "ppo")
}
SMALL = [
    "grid.size=3",
    "optimal.enabled=false",
    "evaluation.every=4",
    "collector.total_frames=61440",
]
BATCHES = ["collector.frames_per_batch=2048", "collector.envs=64"]


def command(folder: Path, *words: str) -> list[str]:
    return [sys.executable, "-m", "trackmdp.app.cli", "train", f"hydra.run.dir={folder}", *words]


def train(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(folder, *words), capture_output=True, text=True, check=False, env=environment()
    )


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1"}


def cut(folder: Path, number: int, after: int, *words: str) -> int:
    """Start a run, send it a signal once `metrics.csv` has `after` rows, and return its exit status."""
    with subprocess.Popen(
        command(folder, *words), env=environment(), stdout=subprocess.DEVNULL
    ) as process:
        while process.poll() is None and len(rows(folder)) < after:
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.01)
        process.send_signal(number)
        return process.wait()


def resumes_exactly(folder: Path, recipe: str, kills: int) -> None:
    """`kills` SIGKILLs at random moments, then on to the end: equal to a run that was never cut."""
    words = [*SMALL, *BATCHES, *(word.format(folder=folder) for word in RECIPES[recipe])]
    (folder / "map.csv").write_text("0,0,0\n0,0,1\n1,1,1\n")
    assert train(folder / "whole", *words).returncode == 0
    whole, moments = len(rows(folder / "whole")), random.Random(recipe)
    words += ["resume=auto", "checkpoint.every=2048", "checkpoint.seconds=0.05"]
    for _ in range(kills):
        done = len(rows(folder / "cut"))
        cut(
            folder / "cut",
            signal.SIGKILL,
            min(whole, done + moments.randint(1, max(2, whole // (kills + 1)))),
            *words,
        )
    last = train(folder / "cut", *words)
    assert last.returncode == 0, last.stderr
    assert_same_run(folder / "whole", folder / "cut")


@pytest.mark.slow
@pytest.mark.parametrize(
    "recipe", ["dqn-prioritized", "hindsight-memory", "hindsight-mixed", "learned-told", "ppo-miss"]
)
def test_a_kill_changes_nothing(tmp_path: Path, recipe: str) -> None:
    resumes_exactly(tmp_path, recipe, kills=1)


@pytest.mark.long
@pytest.mark.parametrize("recipe", RECIPES)
def test_twenty_kills_change_nothing(tmp_path: Path, recipe: str) -> None:
    resumes_exactly(tmp_path, recipe, kills=20)


@pytest.mark.slow
def test_a_signal_saves_and_says_so(tmp_path: Path) -> None:
    number = signal.SIGTERM
    words = [*SMALL, *BATCHES, *RECIPES["hindsight"], "checkpoint.seconds=null"]
    assert cut(tmp_path / "cut", number, 5, *words) == 128 + number
    done = rows(tmp_path / "cut")
    assert 5 <= len(done) < 30
    assert checkpoint.load(checkpoint.newest(tmp_path / "cut"))["iteration"] == len(done)
    assert not (tmp_path / "cut" / "summary.json").exists()
