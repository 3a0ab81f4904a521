"""Benchmarks of worlds whose beliefs spread: the worlds are what they are called, the rows say what was lost."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trackmdp.app.bench import spreading
from trackmdp.app.cli import main


def bench(folder: Path, *words: str) -> list[dict[str, float | str]]:
    assert main(["benchmark", *words, "quiet=true", f"hydra.run.dir={folder}"]) == 0
    return json.loads((folder / "benchmark.json").read_text())["rows"]


def test_all_worlds_can_be_made_and_are_what_they_are_called() -> None:
    made = {name: make() for name, make in spreading.worlds(6, 2).items()}
    assert len(made) == 52
    assert {(world.size, world.t_max) for world in made.values()} == {((6, 6), 2)}
    assert {name for name, world in made.items() if world.safe_cost == 1000} == {n for n in made if "D 1000" in n}
    rare, far, many = (made[name].kernel.toarray() for name in ("rare far jumps", "far jumps", "20 successors c .08"))
    row, column = np.divmod(np.arange(36), 6)
    distance = np.maximum(abs(row[:, None] - row), abs(column[:, None] - column))
    # Some far jumps end nearby: on 6 x 6 cells, two thirds and more do not.
    assert 0.01 < (rare * (distance > 1)).sum(axis=1).mean() < 0.03
    assert 0.15 < (far * (distance > 1)).sum(axis=1).mean() < 0.3
    assert (many > 0).sum(axis=1).max() == 20
    for kernel in (rare, far, many):
        np.testing.assert_allclose(kernel.sum(axis=1), 0.995)


def test_regret_of_both_learners_over_the_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spreading, "ALGOS", ("learned_kernel",))
    words = ["part=regret", "grid.size=4", "worlds=[walk c .4,Z 9 c .16]"]
    both, first = bench(tmp_path / "a", *words, "seeds=[0,1]"), bench(tmp_path / "b", *words, "seeds=[0]")
    assert [row["world"] for row in both] == [row["world"] for row in first] == ["walk c .4", "Z 9 c .16"]
    for two, one in zip(both, first, strict=True):
        assert two["worst"] >= max(two["mean"], one["worst"]) >= min(two["mean"], one["worst"]) >= -1e-9
        assert two["bracket"] <= two["worst"] + 1e-9


def test_the_best_found_is_looked_for_from_other_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk of two free misses whose bracket is left open: more is lost to the best of them than to the solver's."""
    monkeypatch.setattr(spreading, "ALGOS", ("learned_kernel",))
    monkeypatch.setattr(spreading, "STARTS", 4)
    words = ["part=regret", "grid.size=6", "grid.t_max=2", "worlds=[diagonal c .2]", "seeds=[0]", "nodes=1"]
    (far,) = bench(tmp_path / "a", *words)
    monkeypatch.setattr(spreading, "best_of", lambda world, layers, sets, others: sets)
    (near,) = bench(tmp_path / "b", *words)
    assert near["bracket"] == far["bracket"] > 0.001
    assert 0 <= near["worst_to_best"] < far["worst_to_best"] <= far["worst"]


def test_what_is_proved(tmp_path: Path) -> None:
    (row,) = bench(tmp_path / "run", "part=bracket", "worlds=[walk c .1]", "nodes=1000")
    assert (row["world"], row["N"], row["T_max"]) == ("walk c .1", 10, 2)
    assert 0 <= row["bracket_per_step"] < 1e-3
