"""Small training runs in this process, what they left, and when two of them are the same run."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.helpers import train_config
from trackmdp.app.commands.train import run
from trackmdp.training import checkpoint
from trackmdp.training.loggers import CsvLogger
from trackmdp.untrusted import known_object

TIMED = ("seconds", "frames_per_second")
QUICK = (
    "grid.size=3",
    "quiet=true",
    "optimal.enabled=false",
    "evaluation.every=4",
    "checkpoint.seconds=null",
)
BUDGET = (
    "collector.total_frames=2048",
    "collector.frames_per_batch=256",
    "collector.envs=32",
    "checkpoint.every=256",
)
SMALL = {
    "ppo": ("algo=ppo", "algo.hidden=16"),
    "a2c": ("algo=a2c", "algo.hidden=16"),
    "dqn": (
        "algo=dqn",
        "algo.hidden=16",
        "algo.buffer_size=1000",
        "algo.batch_size=64",
        "algo.updates=2",
    ),
    "hindsight": (
        "algo=hindsight",
        "algo.hidden=16",
        "algo.batch_size=64",
        "algo.updates=8",
        "algo.updates_per_iteration=2",
    ),
}
"""Eight iterations of collecting each; `hindsight` learns in four more."""


def train(folder: Path, *overrides: str, algo: str = "ppo") -> float:
    """What `trackmdp train` does once the config is checked, without a process of its own."""
    if not folder.is_dir():
        folder.mkdir()
    return run(train_config(*SMALL[algo], *QUICK, *BUDGET, *overrides), folder)


def at_iteration(patch: pytest.MonkeyPatch, iteration: int, action: Callable[[], Any]) -> None:
    """Do something once the metrics of this iteration are written, before its checkpoint."""
    write = CsvLogger.write

    def written(self: CsvLogger, row: Any) -> None:
        write(self, row)
        if row["iteration"] == iteration:
            action()

    patch.setattr(CsvLogger, "write", written)


class Killed(BaseException):
    """The process ends here: nothing is closed."""


def killed() -> None:
    raise Killed


def breaks() -> None:
    raise OSError(5, "Input/output error")


def killed_and_resumed(folder: Path, iteration: int, *overrides: str, algo: str = "ppo") -> None:
    """A run that ends once this iteration is recorded, before its checkpoint, and goes on."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        at_iteration(patch, iteration, killed)
        train(folder, *overrides, algo=algo)
    train(folder, *overrides, "resume=auto", algo=algo)


def rows(folder: Path) -> list[dict[str, str]]:
    """Rows of `metrics.csv` without the columns that time decides."""
    file = folder / "metrics.csv"
    if not file.is_file():
        return []
    with file.open(newline="") as stream:
        return [{k: v for k, v in row.items() if k not in TIMED} for row in csv.DictReader(stream)]


def tensors(state: Any, prefix: str = "") -> dict[str, Any]:
    """Every leaf of a checkpoint but times, places in files, and the best of those that happened to be saved."""
    if isinstance(state, dict):
        found: dict[str, Any] = {}
        for key, value in state.items():
            if key not in ("seconds", "callbacks"):
                found |= tensors(value, f"{prefix}.{key}")
        return found
    if isinstance(state, (list, tuple)):
        return {
            k: v
            for i, value in enumerate(state)
            for k, v in tensors(value, f"{prefix}[{i}]").items()
        }
    return {prefix: state}


def digest_of_metrics(folder: Path) -> Any:
    """The digest of `metrics.csv` in the summary, in which times have no part; None of a run that has not ended."""
    return known_object(folder / "summary.json").get("files", {}).get("metrics.csv")


def assert_same_run(one: Path, other: Path) -> None:
    assert rows(one) == rows(other)
    assert digest_of_metrics(one) == digest_of_metrics(other)
    mine, theirs = (tensors(checkpoint.load(checkpoint.newest(run))) for run in (one, other))
    assert mine.keys() == theirs.keys()
    for key, value in mine.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, theirs[key]), key
        else:
            assert value == theirs[key], key
