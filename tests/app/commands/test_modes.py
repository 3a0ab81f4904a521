"""Targets with a mode by the command line: verify, report, memory, and large systems of pairs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from tests.typed import refused
from trackmdp.app.cli import main
from trackmdp.config.compose import compose
from trackmdp.solvers import keyed
from trackmdp.solvers.keyed import KeyedPairs
from trackmdp.solvers.keyed_search import solve_keys
from trackmdp.training.machine import needs
from trackmdp.world.make import make_problem
from trackmdp.world.modes import HiddenWorld

WORLD = ["kernel=heading", "grid.size=3", "kernel.exit_probability=0.1", "quiet=true"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


def test_verify_says_what_has_no_case(here: Path) -> None:
    assert main(["verify", *WORLD, "kernel.reveals=true", f"hydra.run.dir={here}/v"]) == 0
    content = json.loads((here / "v/verification.json").read_text())
    found = {(check["name"], check["verdict"]) for check in content["checks"]}
    assert {("Theorem 1", "no case"), ("Theorem 2", "no case"), ("Theorem 3", "no case"), ("order", "holds")} <= found
    assert all(check["passed"] for check in content["checks"])
    assert content["optimum"]["lower"] == pytest.approx(content["optimum"]["upper"])  # told at t_max = 1: certified
    assert main(["solve", *WORLD, "verify=true", f"hydra.run.dir={here}/s"]) == 0
    assert (here / "s/verification.json").is_file()


@pytest.mark.slow
def test_a_sweep_over_memories_is_reported(here: Path) -> None:
    """There are maps of both policies, of the one that remembers more averaged over its keys; nothing is missing."""
    for memory in ("cell", "displacement"):
        for seed in (0, 1):
            words = ["algo=path_counts", "algo.total_frames=2000", "collector.frames_per_batch=2000", f"seed={seed}"]
            line = ["train", *WORLD, *words, f"task.memory={memory}", f"hydra.run.dir={here}/sweep/{memory}-{seed}"]
            assert main(line) == 0
    assert main(["report", f"sweep={here}/sweep", "quiet=true", f"hydra.run.dir={here}/report"]) == 0
    drawn = sorted(file.name for file in (here / "report/figures").glob("*.csv") if "heading" in file.name)
    assert [name.split("-path")[0] for name in drawn] == ["sets", "sets", "value", "value"]
    assert [sum(f"memory-{memory}" in name for name in drawn) for memory in ("cell", "displacement")] == [2, 2]
    assert not (here / "report/tables/missing.csv").exists()
    # Made again from what it stored.
    assert main(["report", f"sweep={here}/report", "quiet=true", f"hydra.run.dir={here}/again"]) == 0
    pages = [(here / name / "report.html").read_text() for name in ("report", "again")]
    assert pages[0] == pages[1]


def test_tables_of_keys_are_in_the_estimate(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two displacements on a large grid do not fit, and that is said before anything is made."""
    large = ["kernel=heading", "grid.size=64", "task.memory=two_displacements", "quiet=true"]
    train = [*large, "algo=path_counts", f"hydra.run.dir={here}/run"]
    for words in (["solve", *large, f"hydra.run.dir={here}/solved"], ["train", *train]):
        told = refused(capsys, *words)
        assert told.startswith("task.memory=two_displacements: needs about 1")
        assert "GiB, " in told
    cfg = compose("train", {"kernel": "heading", "grid.size": 3, "algo": "path_counts", "task.memory": "displacement"})
    world = make_problem(cfg)
    # 9 · 26 keys, t_max + 1 = 2 sets each.
    assert needs(cfg, world)["task.memory"] == 9 * 26 * 2 * 400 + world.pair_bytes
    assert "task.memory" not in needs(compose("train"), make_problem(compose("train")))


def test_the_estimate_counts_places_and_moves() -> None:
    """Three cells in a row, one mode, always one to the right: 2 places after a move, 1 after two, none after three."""
    kernel = sparse.csr_array(np.diag([0.9, 0.9], 1))
    world = HiddenWorld(kernel, (1, 3), modes=1, cost=0.1, t_max=1)
    places, moves, last = 2 + 1 + 0, 2 + 1 + 0, 0
    assert world.pair_bytes == 64 * places + 12 * moves + 48 * last
    pairs = KeyedPairs(world)
    assert sum(len(layer.rows) for layer in pairs.layers) == places


def test_large_systems_are_iterated_to_the_same_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Factorised and by iteration, value, visits and figures agree to rounding, within the error that is told."""
    cfg = compose("solve", {"kernel": "heading", "grid.size": 4, "task.memory": "displacement", "task.clip": 1})
    world = make_problem(cfg)
    assert isinstance(world, HiddenWorld)
    monkeypatch.setattr(keyed, "_DIRECT", 0)
    iterated = solve_keys(world)
    monkeypatch.setattr(keyed, "_DIRECT", 10**6)
    exact = solve_keys(world)
    assert iterated.lower == pytest.approx(exact.lower, rel=1e-11)
    assert exact.evaluation.error == 0
    assert 0 <= iterated.evaluation.error < 1e-9
    assert iterated.evaluation.accuracy == pytest.approx(exact.evaluation.accuracy, rel=1e-11)


@pytest.mark.parametrize(
    "kernel", ["regimes", "constant_velocity", pytest.param("coordinated_turn", marks=pytest.mark.slow)]
)
def test_every_kernel_is_solved_and_simulated(kernel: str, here: Path) -> None:
    """By the command line, hidden and told: exact = simulated within 3 standard errors, and never above the bound."""
    worth = []
    for reveals in ("false", "true"):
        words = [f"kernel={kernel}", "grid.size=3", f"kernel.reveals={reveals}", "episodes=1500", "quiet=true"]
        folder = here / reveals
        assert main(["evaluate", *words, "baseline=optimal", "seed=1", f"hydra.run.dir={folder}"]) == 0
        found = json.loads((folder / "evaluation.json").read_text())
        exact, played = found["exact"]["aihtr"], found["simulated"]["aihtr"]
        assert abs(played["mean"] - exact) < 3 * played["standard_error"]
        assert exact < found["bounds"]["clocked"]
        worth.append(exact)
    assert worth[0] < worth[1]
