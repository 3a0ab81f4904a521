"""Counting on sensed paths: the paths are those of the targets, and a run of it can be cut, loaded and exported."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.helpers import collect, train_config
from tests.solvers.test_path_counts import SWEEP, walks
from tests.tracks import by_hand, recorded, write
from tests.typed import refused
from trackmdp.algos.path_counts import PathCounts
from trackmdp.algos.segments import SensedPaths
from trackmdp.app.cli import main
from trackmdp.policies.policy import Policy
from trackmdp.solvers.recorded import replay
from trackmdp.training.run import load_run
from trackmdp.world.tracks import Recorded

CPU = torch.device("cpu")
MEMORY = ("kernel=tracks", "kernel.path=t.csv", "algo=path_counts", "task.memory=displacement", "task.clip=1")


def learner(task: Recorded, iterations: int = 2, prior: str = "0") -> PathCounts:
    cfg = train_config(*MEMORY, f"algo.prior={prior}").algo
    return PathCounts(task.task, cfg, iterations=iterations, seed=0, device=CPU)  # type: ignore[arg-type]


def swept(count: int = 20, **more: object) -> Recorded:
    return recorded(by_hand(*[[SWEEP[number % 6] for number in range(13)]] * count, exits=True), **more)


def test_paths_are_those_of_the_targets() -> None:
    """Every finished path is a recorded track, and cut batches make the same paths as one."""
    task = recorded(walks(3, count=5))
    batch = collect(task, Policy.all_on(task), 4, 40)
    whole, parts = SensedPaths(9), SensedPaths(9)
    whole.extend(batch)
    for begin in range(0, 40, 8):
        parts.extend(batch[:, begin : begin + 8])
    ours, theirs = whole.tracks(), parts.tracks()
    assert ours.digest() == theirs.digest()
    recordings = {tuple(part) for part in np.split(task.tracks.cells, task.tracks.first[1:-1])}
    seen = [tuple(part) for part in np.split(ours.cells, ours.first[1:-1])]
    finished = [path for path, exits in zip(seen, ours.exits, strict=True) if exits]
    assert finished
    assert set(finished) <= recordings


def test_a_path_ends_where_the_target_is_missed() -> None:
    """It leaps out of the window of one cell, and is located by force: what it did in between is not known."""
    task = recorded(by_hand([0, 1, 2, 0, 1, 2, 5]), t_max=0, window=1)
    paths = SensedPaths(9)
    paths.extend(collect(task, learner(task).policy, 1, 6))
    tracks = paths.tracks()
    assert [tuple(part) for part in np.split(tracks.cells, tracks.first[1:-1])] == [(0, 1, 2), (1, 2, 5)]


@pytest.mark.parametrize("prior", ["0", "null"])
def test_it_learns_the_zigzag_from_the_environment(prior: str) -> None:
    task = swept(memory="displacement", clip=1)
    algorithm = learner(task, prior=prior)
    figures = algorithm.step(collect(task, algorithm.policy, 20, 20))
    assert replay(task, task.tracks, algorithm.actor).totals[:, 0] == pytest.approx(12 * 0.8)
    assert figures["keys_seen"] > 7


def test_it_continues_from_its_state() -> None:
    task = swept(memory="displacement", clip=1)
    one, other = learner(task), learner(task)
    first, second = (collect(task, one.policy, 5, 30, seed=seed) for seed in (1, 2))
    one.step(first)
    other.load_state_dict(one.state_dict())
    assert (other.actor.dense() == one.actor.dense()).all()
    assert one.step(second) == other.step(second)
    assert (other.actor.dense() == one.actor.dense()).all()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_learned_kernel_of_keys_is_their_counts(here: Path) -> None:
    """On a hidden heading, by the command line: the same policy as that of algo=path_counts, given the same frames."""
    world = ["kernel=heading", "grid.size=3", "kernel.exit_probability=0.1", "task.memory=displacement", "task.clip=1"]
    frames = ["collector.total_frames=4000", "collector.frames_per_batch=1000", "collector.envs=20", "quiet=true"]
    for algo in ("learned_kernel", "path_counts"):
        assert main(["train", f"algo={algo}", *world, *frames, f"hydra.run.dir={here / algo}"]) == 0
    found, same = ((here / algo / "policy.npz").read_bytes() for algo in ("learned_kernel", "path_counts"))
    assert found == same
    assert load_run(here / "learned_kernel").policy.sets.nnz


def test_plans_are_made_three_times_and_at_the_end() -> None:
    """Seven batches: after the second, the fourth and the sixth, and the last."""
    task = swept(memory="displacement", clip=1)
    algorithm, planned = learner(task, iterations=7), []
    for seed in range(7):
        before = algorithm.actor
        algorithm.step(collect(task, algorithm.policy, 5, 10, seed=seed))
        planned.append(algorithm.actor is not before)
    assert planned == [False, True, False, True, False, True, True]


def test_a_run_is_valued_loaded_exported_and_resumed(here: Path) -> None:
    """By the command line: the policy of the folder is keyed, and its figures are those of its tracks."""
    write(here / "t.csv", swept(50).tracks)
    words = ["grid.size=3", "cost.sensor=0.2", "kernel.ends=exit", "algo.total_frames=2000", "collector.envs=10"]
    words += ["collector.frames_per_batch=500", "checkpoint.every=500", "quiet=true", "algo.prior=1"]
    assert main(["train", *MEMORY, *words, f"hydra.run.dir={here}/run"]) == 0
    run = load_run(here / "run")
    assert (run.policy.task.memory, run.policy.task.clip, run.policy.sets.shape[0]) == ("displacement", 1, 9 * 10 * 2)
    assert run.evaluation.aihtr == pytest.approx(12 * 0.8)
    assert main(["evaluate", "run=run", "quiet=true", f"hydra.run.dir={here}/judged"]) == 0
    judged = json.loads((here / "judged/evaluation.json").read_text())
    assert judged["held_out"]["figures"]["policy"]["aihtr"]["mean"] == pytest.approx(12 * 0.8)
    assert "task.memory=cell" in judged["held_out"]["figures"]
    assert "task.memory=cell: share of steps" in (here / "judged/tracks.html").read_text()
    sets = json.loads((here / "judged/sets.json").read_text())
    assert (sets["memory"], len(sets["sets"])) == ({"kind": "displacement", "clip": 1, "classes": 10}, 90)
    # Located in 1, having come from 0: on to 2.
    assert sets["sets"][str(1 * 10 + 1 + 5)][0] == [2]
    before = (here / "run/policy.npz").read_bytes()
    # As if it had been cut after its second batch.
    (here / "run/summary.json").unlink()
    for file in sorted((here / "run/checkpoints").glob("*"))[2:]:
        file.unlink()
    assert main(["train", "resume=auto", *MEMORY, *words, f"hydra.run.dir={here}/run"]) == 0
    assert (here / "run/policy.npz").read_bytes() == before
    assert main(["export", "run=run", "format=torch_export", "quiet=true", f"hydra.run.dir={here}/out"]) == 0
    table = torch.export.load(here / "out/policy.pt2").module()
    assert table(torch.tensor([16]), torch.tensor([0])).nonzero().tolist() == [[0, 2]]


def test_what_remembers_the_cell_alone_says_so(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["task.memory=displacement", "kernel=tracks", "kernel.path=t.csv"]
    told = refused(capsys, "train", "algo=learned_kernel", "algo.prior=2", *more)
    assert told == "algo.prior=2: without effect with task.memory=displacement; algo=path_counts has options"
    told = refused(capsys, "train", "algo=path_counts", "task.memory=displacement")
    assert told.startswith("task.memory=displacement: expected cell with kernel=random_support")
    told = refused(capsys, "train", "algo=path_counts", "task.clip=3")
    assert told == "task.clip=3: without effect with task.memory=cell"
    assert not list(here.iterdir())


def test_a_hidden_heading_is_solved_and_learned(here: Path) -> None:
    """By the command line: what is learned from sensed paths is no better than solved, and valued exactly."""
    world = ["kernel=heading", "grid.size=3", "kernel.exit_probability=0.1", "task.memory=displacement", "task.clip=1"]
    assert main(["solve", *world, "quiet=true", f"hydra.run.dir={here}/solved"]) == 0
    solved = json.loads((here / "solved/solution.json").read_text())
    words = ["algo=path_counts", "algo.total_frames=20000", "collector.frames_per_batch=10000", "quiet=true"]
    assert main(["train", *world, *words, f"hydra.run.dir={here}/run"]) == 0
    learned = load_run(here / "run").evaluation.aihtr
    assert solved["lower"] - 0.5 < learned <= solved["lower"] + 0.05 < solved["upper"]


def test_what_does_not_know_hidden_modes_says_so(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(capsys, "solve", "kernel=heading", "solver=qmdp")
    assert told == "kernel=heading: expected with it solver=optimal, and no blocks"
    told = refused(capsys, "benchmark", "kernel=heading")
    assert told == "kernel=heading: expected a kernel without a hidden mode"
    told = refused(capsys, "train", "algo=path_counts", "kernel=heading", "kernel.reveals=true")
    assert told.startswith("algo=path_counts: expected one of a2c, ")
    assert told.endswith(" with kernel=heading and kernel.reveals=true")
    memory = ["kernel=heading", "task.memory=displacement"]
    told = refused(capsys, "train", *memory, "algo.collect=mixed")
    assert told == "algo.collect=mixed: expected all_on with task.memory=displacement"
    told = refused(capsys, "train", *memory, "sensor=miss", "sensor.p_d=.9")
    assert told == "sensor=miss: expected perfect with algo=hindsight and task.memory=displacement"
    told = refused(
        capsys, "train", "algo=learned_kernel", "kernel=heading", "kernel.reveals=true", "algo.share_cells=all"
    )
    assert told == "algo.share_cells=all: expected none or null with kernel.reveals=true"
    told = refused(capsys, "solve", "task.memory=displacement")
    assert told.startswith("task.memory=displacement: expected cell with kernel=random_support")
    assert not list(here.iterdir())
