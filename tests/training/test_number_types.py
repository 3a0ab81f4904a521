"""Checkpoints with numbers of other types than those of the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.helpers import later, small_world
from tests.training.runs import train
from tests.training.test_state import forged
from trackmdp.app.cli import main
from trackmdp.training import checkpoint


def as_type(state: Any, kind: torch.dtype) -> Any:
    """A state with all of its floating-point tensors of another type."""
    if isinstance(state, dict):
        return {name: as_type(part, kind) for name, part in state.items()}
    return (
        state.to(kind)
        if isinstance(state, torch.Tensor) and state.dtype.is_floating_point
        else state
    )


@pytest.mark.parametrize(
    ("algo", "part", "kind"),
    [
        ("ppo", "policy", torch.float64),
        ("dqn", "loss", torch.complex64),
        ("dqn", "buffer", torch.float64),
        ("hindsight", "learner", torch.complex64),
        *later(
            [
                ("dqn", "loss", torch.float64),
                ("ppo", "policy", torch.complex64),
                ("dqn", "buffer", torch.complex64),
                ("hindsight", "learner", torch.float64),
            ]
        ),
    ],
)
def test_numbers_of_another_type_are_refused_in_one_line(
    algo: str, part: str, kind: torch.dtype, tmp_path: Path, capfd: Any
) -> None:
    """Not in a traceback of the first update, nor after a warning of torch's that imaginary parts are lost."""
    train(tmp_path / "run", algo=algo)
    state = checkpoint.load(checkpoint.newest(tmp_path / "run"))["algorithm"]
    forged(tmp_path / "run", algorithm={**state, part: as_type(state[part], kind)})
    capfd.readouterr()
    words = ["collector.total_frames=4096", "checkpoint.keep=1"]
    assert main(["train", f"resume={tmp_path / 'run'}", *words]) == 2
    error = capfd.readouterr().err
    assert (len(error.splitlines()), f"{kind}, expected" in error) == (1, True)


def test_whole_rewards_in_a_buffer_are_refused(tmp_path: Path, capfd: Any) -> None:
    """The first batch would else end in a traceback of torch's."""
    train(tmp_path / "run", algo="dqn")
    state = checkpoint.load(checkpoint.newest(tmp_path / "run"))["algorithm"]
    stored = state["buffer"]["_storage"]["_storage"]
    stored["next.reward"] = stored["next.reward"].long()
    forged(tmp_path / "run", algorithm=state)
    capfd.readouterr()
    words = ["collector.total_frames=4096", "checkpoint.keep=1"]
    assert main(["train", f"resume={tmp_path / 'run'}", *words]) == 2
    assert "next.reward: torch.int64, expected torch.float32" in capfd.readouterr().err


FEW = {"total_frames": 4096, "frames_per_batch": 2048, "envs": 64}


@pytest.fixture
def double() -> Iterator[Callable[[], None]]:
    """Makes float64 torch's default type until the end of the test."""
    yield partial(torch.set_default_dtype, torch.float64)
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("algo", ["a2c", "hindsight"])
def test_the_users_own_default_type_changes_nothing(algo: str, double: Callable[[], None]) -> None:
    more = {"updates": 3, "batch_size": 64} if algo == "hindsight" else {}
    world = small_world()
    policy = tm.train(world, algo, **FEW, **more).policy
    double()
    other = tm.train(world, algo, **FEW, **more).policy
    assert (policy.sets != other.sets).nnz == 0
    assert torch.get_default_dtype() == torch.float64


def test_a_run_is_read_under_any_default_type(tmp_path: Path, double: Callable[[], None]) -> None:
    group, exact = (
        tm.Group([small_world()] * 2),
        {"optimal.enabled": False, "evaluation.width": 0.1},
    )
    tm.train(group, "a2c", folder=tmp_path / "run", **FEW, **exact)
    found = tm.evaluate(group, tm.load_run(tmp_path / "run"), width=0.1)
    double()
    again = tm.evaluate(group, tm.load_run(tmp_path / "run"), width=0.1)
    assert np.array_equal(found.totals, again.totals)
