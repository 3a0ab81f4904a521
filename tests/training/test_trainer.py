"""When the trainer saves, what its callbacks are told, and what collecting has cost."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.helpers import small_world, train_config
from tests.training.runs import BUDGET, QUICK, rows, train
from trackmdp.app.commands.train import run
from trackmdp.config import CheckpointConfig
from trackmdp.policies.policy import Policy
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.callbacks import Callback, Position, Training
from trackmdp.training.collect import make_collector
from trackmdp.training.evaluator import ExactEvaluator
from trackmdp.training.state import Checkpoints
from trackmdp.world.configured import build_world


@pytest.mark.parametrize(
    ("frames", "seconds", "rest", "due"),
    [
        (0, 29.0, 0.0, False),
        (0, 30.0, 0.0, True),
        (0, 99.0, 100.0, False),
        (0, 100.0, 100.0, True),
        (999, 1.0, 0.0, False),
        (1000, 1.0, 100.0, True),
    ],
)
def test_saved_by_frames_or_by_time_but_not_most_of_the_time(
    frames: int, seconds: float, rest: float, due: bool
) -> None:
    checkpoints = Checkpoints(CheckpointConfig(every=1000, seconds=30.0, keep=1), Path())
    checkpoints._saved, checkpoints._rest = Position(10, 5000, 500.0), rest
    assert checkpoints.due(Position(11, 5000 + frames, 500.0 + seconds)) is due


def test_neither_by_frames_nor_by_time() -> None:
    checkpoints = Checkpoints(CheckpointConfig(every=0, seconds=None, keep=1), Path())
    checkpoints._saved = Position()
    assert not checkpoints.due(Position(10, 10**9, 10.0**9))


def test_what_collecting_costs_is_in_the_log(tmp_path: Path) -> None:
    """All sensors on: each frame of an episode costs 9 c but for the exit, and earns r where the target is sensed."""
    train(tmp_path, algo="hindsight")
    table, summary = rows(tmp_path), json.loads((tmp_path / "summary.json").read_text())
    earned = [float(row["reward_per_frame"]) for row in table if row["reward_per_frame"]]
    assert len(earned) == 8
    world = build_world(train_config(*QUICK))
    everything = np.ones((9, 2, 9), dtype=bool)
    exact = evaluate(world, everything)
    assert np.mean(earned) == pytest.approx(exact.aihtr / exact.expected_length, rel=0.02)
    best = ExactEvaluator(world).upper / exact.expected_length
    regrets = [float(row["regret_while_collecting"]) for row in table]
    running = np.cumsum(earned) / np.arange(1, 9)
    assert regrets[:8] == pytest.approx(list(best - running), abs=1e-6)
    assert regrets[8:] == pytest.approx([regrets[7]] * (len(regrets) - 8), rel=1e-12)
    cost = summary["while_collecting"]
    assert cost["reward_per_frame"] == pytest.approx(running[-1])
    assert cost["regret_per_frame"] == pytest.approx(best - running[-1])


def test_rewards_are_logged_as_the_world_pays_them(tmp_path: Path) -> None:
    """Before a learner scales them."""
    for scale in ("0.1", "1"):
        train(tmp_path / scale, f"algo.reward_scale={scale}", "collector.total_frames=256")
    first, other = (rows(tmp_path / scale)[0]["reward_per_frame"] for scale in ("0.1", "1"))
    assert first == other != "0.0"


class _Batches(Callback):
    """Keeps all batches."""

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def on_batch(self, trainer: Training, batch: Any) -> None:
        self.kept.append(batch.clone())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("collector", "shape"), [("single", (4, 8)), ("multi_sync", (8, 4)), ("multi_async", (4, 8))]
)
def test_a_batch_is_rows_by_time_from_every_collector(
    collector: str, shape: tuple[int, int]
) -> None:
    """Sums over n steps go along the second dimension: there each step begins where the one before ended."""
    seen = _Batches()
    more = {"collector": collector, "collector.envs": 4, "evaluation.every": 9}
    world = tm.make_world(size=3)
    budget = {"total_frames": 64, "frames_per_batch": 32, "hidden": 16, "n_step": 3}
    tm.train(world, "dqn", callbacks=[seen], **budget, **more, **{"optimal.enabled": False})
    for batch in seen.kept:
        assert batch.shape == shape
        before, after = batch["next"][:, :-1], batch[:, 1:]
        goes_on = ~before["done"].squeeze(-1)
        assert goes_on.any()
        assert (before["last_cell"] == after["last_cell"])[goes_on].all()


def test_a_budget_is_made_up_to_whole_batches(tmp_path: Path) -> None:
    """Without a word about it at the terminal: warnings are errors here."""
    train(tmp_path, "collector.total_frames=600")
    assert int(rows(tmp_path)[-1]["frames"]) == 768


@pytest.mark.parametrize(("done", "left"), [(0, 2), (256, 1), (512, 0), (1024, 0)])
def test_no_frames_are_left_of_a_budget_that_is_spent(done: int, left: int) -> None:
    """On resume it may be below what was collected already."""
    cfg, world = train_config(*QUICK[:3], *BUDGET, "collector.total_frames=384"), small_world()
    collector = make_collector(cfg, world, Policy.none(world), torch.device("cpu"), done=done)
    assert len(list(islice(collector, 9))) == left


def test_a_plan_is_valued_once_and_a_net_whenever_it_is_due(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    score = ExactEvaluator.score
    monkeypatch.setattr(
        ExactEvaluator, "score", lambda self, policy: [asked.append(policy), score(self, policy)][1]
    )
    folder = tmp_path / "plans"
    folder.mkdir()
    words = ("algo=model_based", "algo.plan_every=4", "evaluation.every=1")
    run(train_config(*words, *QUICK[:3], *BUDGET), folder)
    # all on, two plans in eight iterations, and the last of them once more for the summary
    plans = len(asked)
    assert (plans, len(rows(folder))) == (4, 8)
    train(tmp_path / "net", "evaluation.every=1", algo="a2c")
    assert len(asked) - plans > len(rows(tmp_path / "net"))
