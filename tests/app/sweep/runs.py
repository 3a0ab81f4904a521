"""Sweeps of tiny runs, as a user types them."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from trackmdp.app.cli import main
from trackmdp.app.sweep import process
from trackmdp.training.folders import RunState, run_of

ROOT = Path(__file__).parents[3]
TINY = (
    "grid.size=3",
    "collector.total_frames=2048",
    "collector.frames_per_batch=1024",
    "collector.envs=64",
    "algo=hindsight",
    "algo.updates=4",
    "algo.hidden=8",
    "optimal.nodes=100000",
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, and runs that begin as a copy of this process, with all that is patched in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "context_for", lambda _: multiprocessing.get_context("fork"))
    return tmp_path


def swept(*words: str, dir: str = "all") -> int:
    """The exit status of a sweep of tiny runs in the folder `dir`, in this process."""
    return main(["train", "-m", *TINY, *words, f"hydra.sweep.dir={dir}"])


_started: list[subprocess.Popen[str]] = []


@pytest.fixture(autouse=True)
def nothing_left() -> Iterator[None]:
    """Whatever a test started ends with it."""
    yield
    while _started:
        process = _started.pop()
        process.kill()
        process.communicate()


def started(folder: Path, *words: str, **kwargs: Any) -> subprocess.Popen[str]:
    """The command as typed in a shell, in `folder`."""
    process = subprocess.Popen(
        [sys.executable, "-m", "trackmdp.app.cli", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **kwargs,
    )
    _started.append(process)
    return process


def runs_of(folder: Path) -> list[RunState]:
    """The runs of a sweep, in the order planned."""
    jobs = json.loads((folder / "sweep.json").read_text())["jobs"]
    return [run_of(folder / job["folder"], tuple(job["overrides"])) for job in jobs]


def table(folder: Path) -> list[dict[str, str]]:
    """Rows of `runs.csv`."""
    with (folder / "runs.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def states(folder: Path) -> list[str]:
    return [row["state"] for row in table(folder)]
