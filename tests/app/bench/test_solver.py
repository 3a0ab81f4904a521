"""The benchmark parts of the solver and of the learned kernel, on the smallest worlds that go through all of it."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import configured
from trackmdp.app.bench import learned, solver
from trackmdp.world.make import build_world


@pytest.mark.slow
def test_growth_gives_a_row_per_world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "PAIRS", ((5, 0.22),))
    monkeypatch.setattr(solver, "SIZES", (3, 4))
    monkeypatch.setattr(solver, "T_MAX", (1,))
    cfg = configured("benchmark", "part=solver")
    rows = solver.solver(cfg, build_world(cfg), torch.device("cpu"))
    assert [(row["N"], row["T_max"], row["certified"]) for row in rows] == [(3, 1, True), (4, 1, True)]
    for row in rows:
        assert row["solve_seconds"] > 0
        assert 0 <= row["gap_per_step"] < 1e-5
        assert 20 < row["peak_mib"] < 1000


@pytest.mark.slow
def test_the_learned_kernel_gives_a_row_per_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned, "VARIANTS", (("all", 10_000),))
    monkeypatch.setattr(learned, "SUPPORTS", (3, 5))
    monkeypatch.setattr(learned, "COSTS", (0.16,))
    cfg = configured("benchmark", "part=learned_kernel", "seeds=[0,1]")
    rows = list(learned.learned_kernel(cfg, build_world(cfg), torch.device("cpu")))
    assert [(row["Z"], row["c"], row["frames"]) for row in rows] == [(3, 0.16, 10_000), (5, 0.16, 10_000)]
    for row in rows:
        assert 0 < row["mean_regret"] <= row["worst_regret"] < 0.1
        assert row["sensors_per_frame"] == pytest.approx(100.0)
        assert row["curve"]["frames"] == [5000, 10_000]
        assert len(row["curve"]["regret"]) == 2
