"""Evaluating on held-out tracks: by hand, beside references that know no more, and never part of learning."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse

from tests.helpers import ALGORITHMS, algorithm, collect, later, limited, small_world
from tests.tracks import by_hand, drawn, recorded, write
from tests.training.runs import rows as metrics
from tests.training.runs import tensors
from tests.training.runs import train as train_run
from trackmdp.app.sweep.sweep import run_figures
from trackmdp.policies.policy import Policy
from trackmdp.recordings.tracks import Recorded, Tracks, read_tracks, split
from trackmdp.solvers import rules
from trackmdp.training import checkpoint
from trackmdp.training.evaluator import (
    CELL_ALONE,
    ESTIMATED,
    ExactEvaluator,
    HeldOutEvaluator,
    Score,
    estimated_kernel,
)
from trackmdp.training.folders import run_of
from trackmdp.training.group_run import evaluator_of
from trackmdp.world.model import World
from trackmdp.world.problem_file import PROBLEM, read_problem


def test_the_setting_decides_who_evaluates() -> None:
    world = small_world()
    assert type(evaluator_of(world, 0)) is ExactEvaluator
    assert type(evaluator_of(recorded(drawn(world.kernel, 5)), 0)) is HeldOutEvaluator


def test_a_regret_says_where_no_better_policy_is_known() -> None:
    found = ExactEvaluator(small_world()).evaluate(Policy.none(small_world()))
    last = "0.1700 to the upper bound"
    assert Score(found, 0.17, 0.0).regret == f"regret per step {last}; no better policy is known"
    assert Score(found, 0.17, 0.05).regret.endswith(f"0.0500 to the best policy known, {last}")
    assert Score(found, 0.17, 0.17).regret == f"regret per step {last}"


def test_only_the_held_out_tracks_count() -> None:
    """All on: r - 9 c a step in the grid, nothing on the exit step."""
    others = by_hand([0, 1, 2], [3, 3])
    setting = recorded(
        others, by_hand([4, 5], [4, 5, 6, 7], [8, 8]), validation=by_hand([4, 5, 5, 5, 5])
    )
    evaluator = HeldOutEvaluator(setting)
    evaluation = evaluator.evaluate(Policy.all_on(setting))
    assert evaluation.aihtr == pytest.approx((1 + 3 + 1) / 3 * (1 - 1.8))
    assert evaluation.expected_length == pytest.approx((2 + 4 + 2) / 3)
    assert (evaluation.accuracy, evaluation.sensors_per_step) == (1.0, 9.0)
    assert math.isnan(evaluator.upper)
    score = evaluator.score(Policy.all_on(setting))
    assert score.evaluation.aihtr == pytest.approx(4 * -0.8)
    assert math.isnan(score.regret_per_step)
    value = evaluation.value
    assert value[[4, 8]] == pytest.approx([2 * -0.8, -0.8])
    assert np.isnan(np.delete(value, [4, 8])).all()


def test_episodes_are_cut_where_the_limit_is() -> None:
    setting = recorded(by_hand([0, 1], [0, 1]), by_hand([4, 5, 6, 7], [8, 8]))
    evaluation = HeldOutEvaluator(limited(setting, 2)).evaluate(Policy.all_on(setting))
    assert evaluation.aihtr == pytest.approx((2 + 1) / 2 * -0.8)
    assert evaluation.expected_length == 2.0


def test_the_report_holds_the_policy_and_the_references() -> None:
    world = small_world()
    setting = recorded(drawn(world.kernel, 300), drawn(world.kernel, 80, seed=1))
    evaluator = HeldOutEvaluator(setting)
    policy = Policy.from_dense(world, np.random.default_rng(0).random((9, 2, 9)) < 0.3)
    report = evaluator.held_out(policy)
    assert (report["tracks"], report["learned_from"]) == (80, 300)
    assert set(report["figures"]) == {"policy", "all on", "no sensors", ESTIMATED}
    assert (
        report["figures"]["all on"]["aihtr"]["mean"] < report["figures"]["policy"]["aihtr"]["mean"]
    )
    assert report["figures"]["policy"]["aihtr"]["mean"] == pytest.approx(
        evaluator.evaluate(policy).aihtr
    )
    for figures in report["figures"].values():
        assert all(each["low"] <= each["mean"] <= each["high"] for each in figures.values())


def test_what_remembers_more_is_compared_with_the_cell_alone() -> None:
    """From 1 the target goes on as it came, to 0 or to 2: .8 a step for who remembers, .6 for who senses both."""
    there, back = [0, 1, 2], [2, 1, 0]
    task = recorded(by_hand(*[there, back] * 20), memory="displacement", clip=1)
    evaluator = HeldOutEvaluator(task)
    found = evaluator.replayed(evaluator.references[CELL_ALONE]).intervals(task.held_out.names)
    assert found["aihtr"].mean == pytest.approx(0.8 + 0.6)
    assert list(evaluator.held_out(Policy.none(task))["figures"])[:2] == ["policy", CELL_ALONE]
    assert CELL_ALONE in HeldOutEvaluator(replace(task, detection=0.9)).references
    assert CELL_ALONE not in HeldOutEvaluator(replace(task, memory="cell")).references


def test_the_estimated_kernel_is_that_of_the_tracks() -> None:
    world = small_world(exit_probability=0.05)
    many = estimated_kernel(drawn(world.kernel, 20_000), 3)
    assert np.abs(many - world.kernel.toarray()).max() < 0.01
    exits = estimated_kernel(drawn(world.kernel, 20_000), 3).sum(axis=1)
    stopped = drawn(world.kernel, 20_000)
    cut = Tracks(stopped.cells, stopped.first, np.zeros(20_000, dtype=bool), stopped.names)
    assert exits == pytest.approx(np.full(9, 0.95), abs=0.01)
    assert (
        estimated_kernel(cut, 3).sum(axis=1) > 0.999
    ).all()  # where the recording stopped nobody left


@pytest.mark.parametrize("window", [None, 1])
def test_q_mdp_of_the_estimated_kernel_is_that_of_the_kernel(window: int | None) -> None:
    """The price is .2, the probabilities .6 and .3: none is so near to it that the estimate would matter.

    From cell 0 cell 2 is outside of a window of 1.
    """
    kernel = 0.6 * np.roll(np.eye(9), 2, axis=1) + 0.3 * np.roll(np.eye(9), 1, axis=1)
    setting = recorded(drawn(sparse.csr_array(kernel), 5_000), by_hand([0, 1]), window=window)
    world = World(
        kernel,
        3,
        cost=setting.cost,
        safe_cost=setting.safe_cost,
        t_max=setting.t_max,
        reward=setting.reward,
        window=window,
    )
    assert np.array_equal(
        HeldOutEvaluator(setting).references[ESTIMATED].dense(), rules.qmdp(world).dense()
    )


FILE = drawn(small_world(exit_probability=0.05).kernel, 60)
WORDS = ("kernel=tracks", "kernel.min_length=1")
FEW = "collector.total_frames=1024"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write(tmp_path / "tracks.csv", FILE)


def run(folder: Path, file: Path, *words: str, algo: str = "hindsight") -> dict[str, Any]:
    train_run(folder, *WORDS, f"kernel.path={file}", *words, algo=algo)
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of an algorithm's runs: on the recording, and with other cells in one of its parts."""

    @cache
    def trained(algo: str) -> Path:
        folder = tmp_path_factory.mktemp(algo)
        whole = write(folder / "tracks.csv", FILE)
        run(folder / "clean", whole, FEW, algo=algo)
        for name, part in zip(PARTS, parts(whole), strict=True):
            run(folder / name, poisoned(folder / f"{name}.csv", part), FEW, algo=algo)
        return folder

    return trained


def test_a_run_says_nothing_that_takes_a_kernel(file: Path, tmp_path: Path) -> None:
    summary = run(tmp_path / "run", file)
    assert (summary["qmdp"], summary["optimal"], summary["regret_per_step"]) == (None, None, None)
    assert set(summary["bounds"].values()) == {None}
    assert summary["held_out"]["tracks"] == 12
    assert summary["held_out"]["validation"] == 6
    assert summary["held_out"]["learned_from"] == 42
    figures = summary["held_out"]["figures"]["policy"]
    assert figures["aihtr"]["mean"] == pytest.approx(summary["policy"]["aihtr"])
    evaluated = [row for row in metrics(tmp_path / "run") if row["aihtr"]]
    assert {row["regret_per_step"] for row in metrics(tmp_path / "run")} == {""}
    assert (
        float(evaluated[-1]["aihtr"])
        == summary["validation"]["aihtr"]
        != summary["policy"]["aihtr"]
    )
    kept = read_problem(tmp_path / "run" / PROBLEM)
    assert isinstance(kept, Recorded)
    assert [len(part) for part in (kept.tracks, kept.validation, kept.held_out)] == [42, 6, 12]


@pytest.mark.parametrize("algo", ["hindsight", *later(["ppo"])])
def test_only_its_own_part_is_learned_from(algo: str, runs: Callable[[str], Path]) -> None:
    """Other cells in the held-out or the validation tracks, and the run learns the same; in the others, it does not."""
    folder = runs(algo)
    _, first = checkpoints(folder / "clean")
    for name in PARTS:
        keys, second = checkpoints(folder / name)
        assert all(same(first[key], second[key]) for key in keys) == (name != "learned")
    learned = [strip(row) for row in metrics(folder / "clean")]
    assert learned == [strip(row) for row in metrics(folder / "validation")]


def test_choices_are_made_on_the_validation_tracks_alone(runs: Callable[[str], Path]) -> None:
    """What is looked at while learning, best.pt and Optuna's figure: as they are, whatever the held-out tracks hold."""
    folder = runs("hindsight")
    summaries = {
        name: json.loads((folder / name / "summary.json").read_text()) for name in ("clean", *PARTS)
    }
    assert metrics(folder / "held_out") == metrics(folder / "clean")
    assert metrics(folder / "validation") != metrics(folder / "clean")
    for key, changed in (("validation", "validation"), ("policy", "held_out")):
        assert [
            name
            for name in ("validation", "held_out")
            if summaries[name][key] != summaries["clean"][key]
        ] == [changed]
    # best.pt is the first checkpoint of those with the largest figure on the validation tracks
    shown = {
        int(row["iteration"]): float(row["aihtr"])
        for row in metrics(folder / "clean")
        if row["aihtr"]
    }
    best = checkpoint.load(folder / "clean/checkpoints" / checkpoint.BEST)
    assert best["callbacks"]["checkpoints"]["best"] >= max(shown.values())
    assert shown.get(best["iteration"], math.inf) >= max(shown.values())
    found, clean = run_figures(run_of(folder / "clean")), summaries["clean"]
    assert found["aihtr"] == clean["validation"]["aihtr"] != clean["policy"]["aihtr"]
    assert found["held_out_aihtr"] == clean["policy"]["aihtr"]


PARTS = ("learned", "validation", "held_out")


def parts(file: Path) -> tuple[Tracks, Tracks, Tracks]:
    return split(read_tracks(file, 3, exits=True), 0.2, 0.1, 0)


def poisoned(file: Path, part: Tracks) -> Path:
    """The tracks, those of `part` with other cells."""
    mine = np.repeat(np.isin(FILE.names, part.names), FILE.lengths)
    return write(file, replace(FILE, cells=np.where(mine, 8 - FILE.cells, FILE.cells)))


def checkpoints(folder: Path) -> tuple[list[str], dict[str, Any]]:
    state = tensors(checkpoint.load(checkpoint.newest(folder))["algorithm"])
    return list(state), state


def same(one: Any, other: Any) -> bool:
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


def strip(row: dict[str, str]) -> dict[str, str]:
    return {key: row[key] for key in row if key not in ("aihtr", "accuracy", "sensors_per_step")}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_from_tracks(name: str) -> None:
    setting = recorded(drawn(small_world().kernel, 200))
    learner: Any = algorithm(name, setting)  # type: ignore[arg-type]
    for batch in collect(setting, learner.policy, 32, 32).split(8, dim=1):  # type: ignore[arg-type]
        learner.step(batch)
    for _ in range(learner.iterations - 4 if name == "hindsight" else 0):
        learner.step(None)
    policy = Policy.from_module(setting.task, learner.actor)
    assert np.isfinite(HeldOutEvaluator(setting).score(policy).evaluation.aihtr)
