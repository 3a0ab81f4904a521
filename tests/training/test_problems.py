"""A problem made in Python trains into a folder; resumed, evaluated, exported and reported it is the same problem."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.helpers import later, small_world
from tests.tracks import drawn, recorded
from tests.training.runs import assert_same_run
from trackmdp.app.cli import main
from trackmdp.errors import RunError, UserError
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.training.run import trained
from trackmdp.world.model import World
from trackmdp.world.problem import Problem
from trackmdp.world.problem_file import problem_bytes, problem_digest, read_problem

QUICK: dict[str, Any] = {
    "total_frames": 1024,
    "frames_per_batch": 256,
    "envs": 32,
    "hidden": 8,
    "optimal": {"enabled": False},
    "checkpoint.every": 256,
}


class Stop(Callback):
    """Ends the run in the middle."""

    def on_update(self, trainer: Training, row: Row) -> None:
        if row["iteration"] == 2:
            raise RunError("stopped")


def of_small(**changes: Any) -> Problem:
    return World.of(small_world(), small_world().kernel, **changes)


PROBLEMS: dict[str, Problem] = {
    "prices": of_small(cost=np.linspace(0.1, 0.3, 9), safe_cost=1.5),
    "misses": of_small(detection=np.linspace(0.6, 1.0, 9), safe_detection=0.9),
    "footprints": of_small(coverage=np.eye(9)[:4] + np.eye(9)[5:], cost=0.3),
    "window": of_small(window=1, max_steps=30),
    "modes": tm.make_world("heading", size=3, reveals=True),
    "memory": tm.make_world("heading", size=3, memory="displacement_gap", clip=1),
    "recorded": recorded(drawn(small_world().kernel, 90), memory="displacement", markov=False),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "modes")) for name in PROBLEMS],
)
def test_a_problem_from_python_is_used_by_every_command(name: str, tmp_path: Path) -> None:
    problem = PROBLEMS[name]
    run = tm.train(problem, "a2c", folder=tmp_path / "sweep/whole", **QUICK)
    with pytest.raises(RunError, match="stopped"):
        tm.train(problem, "a2c", folder=tmp_path / "sweep/cut", callbacks=[Stop()], **QUICK)
    assert problem_digest(read_problem(tmp_path / "sweep/cut/problem.npz")) == problem_digest(
        problem
    )
    # From here on by somebody who has nothing but the folder.
    quiet = ["quiet=true", f"hydra.run.dir={tmp_path / 'out'}"]
    assert main(["train", f"resume={tmp_path / 'sweep/cut'}", "quiet=true"]) == 0
    assert_same_run(tmp_path / "sweep/cut", tmp_path / "sweep/whole")
    assert main(["evaluate", f"run={tmp_path / 'sweep/cut'}", "episodes=4", *quiet]) == 0
    assert main(["export", f"run={tmp_path / 'sweep/cut'}", "format=sets", *quiet]) == 0
    assert main(["report", f"sweep={tmp_path / 'sweep'}", "quiet=true"]) == 0
    assert tm.evaluate(problem, tm.load_run(tmp_path / "sweep/cut").policy).aihtr == pytest.approx(
        run.evaluation.aihtr
    )


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 2)])
def test_what_can_be_planned_on_can_be_learned_on(size: tuple[int, int]) -> None:
    """A road is a grid of one row; on so few cells the estimate plans as well as the motion itself."""
    cells = size[0] * size[1]
    world = World(np.full((cells, cells), 0.9 / cells), size, cost=0.05, t_max=1)
    budget = {key: QUICK[key] for key in ("total_frames", "frames_per_batch", "envs", "optimal")}
    run = tm.train(world, "model_based", **budget)
    assert run.evaluation.aihtr == pytest.approx(tm.solve(world).upper)


@pytest.mark.slow
def test_a_config_stays_small_whatever_the_grid(tmp_path: Path) -> None:
    """Written as a list, the 57,600 prices took more than a config may have."""
    prices = np.random.default_rng(0).uniform(0.1, 0.2, 57_600)
    world = tm.make_world("random_walk", size=240, cost=prices, window=3, safe_cost=16.0)
    run = tmp_path / "run"
    budget = {"total_frames": 2000, "frames_per_batch": 2000, "envs": 500}
    tm.train(world, "model_based", folder=run, **budget)
    assert (run / "config.yaml").stat().st_size < 10_000
    out = ["quiet=true", f"hydra.run.dir={tmp_path / 'out'}"]
    assert main(["evaluate", f"run={run}", "episodes=0", *out]) == 0
    assert main(["export", f"run={run}", "format=sets", *out]) == 0
    assert main(["train", f"resume={run}", "quiet=true"]) == 0
    assert main(["report", f"sweep={run}", "quiet=true"]) == 0


@pytest.mark.parametrize("command", ["compare", *later(["evaluate", "export"])])
def test_targets_copied_from_another_run_are_refused_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = {name: QUICK[name] for name in QUICK if name != "hidden"}
    tm.train(small_world(), folder=tmp_path / "run", **quick)
    file = tmp_path / "run/problem.npz"
    file.write_bytes(problem_bytes(tm.Group([small_world()] * 2)))
    capsys.readouterr()
    words = [f"runs=[{tmp_path}/run]", "baselines=[none]"]
    words = words if command == "compare" else [f"run={tmp_path}/run"]
    assert main([command, *words, f"hydra.run.dir={tmp_path}/out"]) == 2
    assert capsys.readouterr().err.endswith(f"{file}: 2 targets, expected 1\n")
    assert not (tmp_path / "out").exists()


def test_a_grid_copied_from_another_run_is_refused(tmp_path: Path) -> None:
    """Before a checkpoint tells, or where there is none: by blocks the config of 12 x 12 cells was taken for 3 x 3."""
    quick = {name: QUICK[name] for name in QUICK if name != "hidden"}
    tm.train(small_world(), folder=tmp_path / "run", **quick)
    file = tmp_path / "run/problem.npz"
    file.write_bytes(problem_bytes(small_world(4)))
    with pytest.raises(UserError, match=r"problem\.npz: 4 x 4 cells, expected 3 x 3 cells$"):
        trained(str(tmp_path / "run"), torch.device("cpu"))
