"""The speed parts measure what they say: every size, every policy, every algorithm, and whole runs where they end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import ALGORITHMS
from trackmdp.app.cli import main


def measured(folder: Path, *words: str) -> list[dict[str, Any]]:
    assert main(["benchmark", "grid.size=3", "seconds=0.01", f"hydra.run.dir={folder}", *words]) == 0
    content = json.loads((folder / "benchmark.json").read_text(encoding="utf-8"))
    assert content["machine"]["cores"] >= 1
    assert content["machine"]["processor"]
    rows: list[dict[str, Any]] = content["rows"]
    assert all(row["per_second"] > 0 and row["cpu_us_each"] > 0 for row in rows)
    return rows


def test_the_environment_at_every_size(tmp_path: Path) -> None:
    rows = measured(tmp_path / "run", "part=env", "batch_sizes=[1,64,1024,8192]")
    assert [row["envs"] for row in rows] == [1, 64, 1024, 8192]
    assert rows[2]["per_second"] > rows[0]["per_second"]


def test_the_environment_with_a_window(tmp_path: Path) -> None:
    (row,) = measured(tmp_path / "run", "part=env", "batch_sizes=[64]", "grid.window=1")
    assert row["envs"] == 64


@pytest.mark.slow
def test_the_collector_with_every_policy(tmp_path: Path) -> None:
    rows = measured(tmp_path / "run", "part=collector")
    assert [(row["policy"], row["envs"]) for row in rows] == [
        (policy, envs) for policy in ("random", "all_on", "actor") for envs in (64, 1024)
    ]


@pytest.mark.slow
def test_training_with_every_algorithm(tmp_path: Path) -> None:
    """A run that collects first and learns afterwards is measured to its end."""
    rows = measured(tmp_path / "run", "part=train", "seconds=4")
    assert [row["algo"] for row in rows] == ALGORITHMS
    assert {row["algo"]: row["whole"] for row in rows}["hindsight"] is True
