"""Targets with a mode by the command line: verify, report, memory, and large systems of pairs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import later
from trackmdp.app.cli import main
from trackmdp.config.compose import compose
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import linear, value
from trackmdp.training.devices import needs
from trackmdp.world.configured import make_problem
from trackmdp.world.model import World

WORLD = ["kernel=heading", "grid.size=3", "kernel.exit_probability=0.1", "quiet=true"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


@pytest.mark.usefixtures("little_search")
def test_verify_says_what_has_no_case(here: Path) -> None:
    assert main(["verify", *WORLD, "kernel.reveals=true", f"hydra.run.dir={here}/v"]) == 0
    content = json.loads((here / "v/verification.json").read_text())
    found = {(check["name"], check["verdict"]) for check in content["checks"]}
    assert {
        ("Theorem 1", "no case"),
        ("Theorem 2", "no case"),
        ("Theorem 3", "no case"),
        ("order", "holds"),
    } <= found
    assert all(check["passed"] for check in content["checks"])
    assert content["optimum"]["lower"] == pytest.approx(
        content["optimum"]["upper"]
    )  # told at t_max = 1: certified
    assert main(["solve", *WORLD, "verify=true", f"hydra.run.dir={here}/s"]) == 0
    assert (here / "s/verification.json").is_file()


@pytest.mark.long
def test_a_sweep_over_memories_is_reported(here: Path) -> None:
    """There are maps of both policies, of the one that remembers more averaged over its keys; nothing is missing."""
    for memory in ("cell", "displacement"):
        for seed in (0, 1):
            words = [
                "algo=model_based",
                "algo.total_frames=2000",
                "collector.frames_per_batch=2000",
                f"seed={seed}",
            ]
            line = [
                "train",
                *WORLD,
                *words,
                f"task.memory={memory}",
                f"hydra.run.dir={here}/sweep/{memory}-{seed}",
            ]
            assert main(line) == 0
    assert (
        main(["report", f"sweep={here}/sweep", "quiet=true", f"hydra.run.dir={here}/report"]) == 0
    )
    drawn = sorted(
        file.name for file in (here / "report/figures").glob("*.csv") if "heading" in file.name
    )
    # One map for the world of what no policy reaches, one of the sets of each memory.
    assert [name.split("-model-based")[0].split("-heading")[0] for name in drawn] == [
        "missing",
        "sets",
        "sets",
    ]
    assert [
        sum(f"memory-{memory}" in name for name in drawn) for memory in ("cell", "displacement")
    ] == [1, 1]
    assert not (here / "report/tables/missing.csv").exists()
    # Made again from what it stored.
    assert (
        main(["report", f"sweep={here}/report", "quiet=true", f"hydra.run.dir={here}/again"]) == 0
    )
    pages = [(here / name / "report.html").read_text() for name in ("report", "again")]
    assert pages[0] == pages[1]


def test_tables_of_keys_are_in_the_estimate() -> None:
    cfg = compose(
        "train",
        {"kernel": "heading", "grid.size": 3, "algo": "model_based", "task.memory": "displacement"},
    )
    # 9 · 26 keys, t_max + 1 = 2 sets each.
    assert needs(cfg, make_problem(cfg))["task.memory"] == 9 * 26 * 2 * 400
    assert "task.memory" not in needs(compose("train"), make_problem(compose("train")))


def test_large_systems_are_iterated_to_the_same_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Factorised and by iteration, value and figures agree to rounding, within the error that is given."""
    cfg = compose(
        "solve",
        {"kernel": "heading", "grid.size": 4, "task.memory": "displacement", "task.clip": 1},
    )
    world = make_problem(cfg)
    assert isinstance(world, World)
    policy = PolicyTable.from_dense(
        world, np.random.default_rng(0).random((world.num_keys, world.num_choices, 16)) < 0.5
    )
    monkeypatch.setattr(linear, "KEYED_DIRECT", 0)
    iterated = value.value_of(world, policy)
    monkeypatch.setattr(linear, "KEYED_DIRECT", 10**6)
    exact = value.value_of(world, policy)
    assert iterated.aihtr == pytest.approx(exact.aihtr, rel=1e-11)
    assert exact.error == 0
    assert 0 < iterated.error < 1e-9
    assert iterated.accuracy == pytest.approx(exact.accuracy, rel=1e-11)


@pytest.mark.usefixtures("little_search")
@pytest.mark.parametrize(
    "kernel",
    ["regimes", *later(["constant_velocity", "coordinated_turn"])],
)
def test_every_kernel_is_solved_and_simulated(kernel: str, here: Path) -> None:
    """By the command line, hidden and told: exact = simulated within 3 standard errors, and never above the bound."""
    worth = []
    for reveals in ("false", "true"):
        words = [
            f"kernel={kernel}",
            "grid.size=3",
            f"kernel.reveals={reveals}",
            "episodes=1500",
            "quiet=true",
        ]
        folder = here / reveals
        assert (
            main(["evaluate", *words, "baseline=optimal", "seed=1", f"hydra.run.dir={folder}"]) == 0
        )
        found = json.loads((folder / "evaluation.json").read_text())
        exact, played = found["exact"]["aihtr"], found["simulated"]["aihtr"]
        assert abs(played["mean"] - exact) < 3 * played["standard_error"]
        assert exact < found["bounds"]["clocked"]
        worth.append(exact)
    assert worth[0] < worth[1]
