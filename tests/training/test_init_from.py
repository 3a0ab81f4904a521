"""Beginning with the weights of another run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.helpers import train_config
from tests.training.runs import BUDGET, QUICK, SMALL, train
from tests.training.test_state import CPU, typed
from trackmdp.algos.common import make_algorithm
from trackmdp.app.cli import main
from trackmdp.training import checkpoint
from trackmdp.training.state import take_weights
from trackmdp.world.configured import build_world


def test_weights_are_taken_where_they_fit(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = checkpoint.load(checkpoint.newest(whole))["algorithm"]
    words = [f"init_from={whole}", "quiet=false", "seed=3", "collector.total_frames=256"]
    assert (
        typed(tmp_path / "same", *words, "algo.learning_rate.start=0", "algo.learning_rate.end=0")
        == 0
    )
    mine = checkpoint.load(checkpoint.newest(tmp_path / "same"))["algorithm"]
    for name in ("policy", "critic"):
        for key, tensor in mine[name].items():
            assert torch.equal(tensor, given[name][key]), key
    assert f"weights from {whole}: " in (out := capsys.readouterr().out)
    assert out.count("encoder.cell,") == 2
    assert typed(tmp_path / "longer", *words, "grid.t_max=2") == 0
    taken = next(
        line for line in capsys.readouterr().out.splitlines() if line.startswith("weights from")
    )
    assert "encoder.cell," in taken
    assert "encoder.history.weight" not in taken
    assert "encoder.stage" not in taken
    for algo, message in (
        ("dqn", "none of its weights has the name and shape of one of ours"),
        ("hindsight", "the learner makes its networks from its data"),
    ):
        folder = f"hydra.run.dir={tmp_path / algo}"
        assert main(["train", *SMALL[algo], *BUDGET, *QUICK, folder, words[0]]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_prices_and_exploration_are_no_weights(tmp_path: Path) -> None:
    """The first batch of the new run is explored as its own options say, and its values count in its own prices."""
    train(tmp_path / "cheap", "cost.sensor=0.1", "collector.total_frames=512", algo="dqn")
    given = checkpoint.load(checkpoint.newest(tmp_path / "cheap"))["algorithm"]
    cfg = train_config(*SMALL["dqn"], *QUICK, *BUDGET)
    learner = make_algorithm(cfg, build_world(cfg).task, CPU)
    epsilon = learner.state_dict()["explore"]["epsilon"].clone()
    assert epsilon != given["explore"]["epsilon"]
    take_weights(learner, tmp_path / "cheap", CPU)
    assert learner.state_dict()["explore"]["epsilon"] == epsilon
    mine, theirs = learner.state_dict()["loss"], given["loss"]
    others = {name for name, part in mine.items() if isinstance(part, torch.Tensor)}
    others -= {name for name in others if mine[name].equal(theirs[name])}
    assert {name.rpartition(".")[2] for name in others} == {"unit"}


def test_a_run_without_weights_is_named_by_its_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    for name, message in (("none", "no such folder"), ("empty", "no checkpoint in ")):
        given = f"init_from={tmp_path / name}"
        assert typed(tmp_path / "new", given, "quiet=false") == 2
        out, error = capsys.readouterr()
        assert not out
        assert error.startswith(f"trackmdp train: {given}: {message}") and error.count("\n") == 1
        assert not (tmp_path / "new").exists()
