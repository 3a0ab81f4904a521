"""Composing without Hydra gives what the command line composes, and refuses in the same words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.config.cases import COMBINATIONS, composed, files_of
from tests.helpers import later
from trackmdp.config.compose import compose
from trackmdp.errors import UserError


def words_of(command: str, choice: str) -> list[str]:
    """What a command needs beside a choice."""
    words = [choice, *files_of(command, choice)]
    return words if command != "evaluate" or "baseline=" in choice else ["baseline=qmdp", *words]


ONCE = {
    choice if choice.startswith(("algo=", "log=")) else choice.partition("=")[0]: (command, choice)
    for command, choice in reversed(COMBINATIONS)
}
FIRST = {command: (command, choice) for command, choice in reversed(COMBINATIONS)}
"""Each algorithm, each log, and a choice of each other group and each command."""


@pytest.mark.parametrize(
    ("command", "choice"), [*FIRST.values(), *later(sorted({*ONCE.values()} - {*FIRST.values()}))]
)
def test_a_config_is_that_of_the_command_line(command: str, choice: str) -> None:
    words = words_of(command, choice)
    overrides = dict(word.split("=", 1) for word in words)
    assert compose(command, overrides) == composed(command, *words)


def test_values_may_be_of_numpy_and_paths() -> None:
    given = {
        "grid.size": np.int64(3),
        "cost.sensor": np.full(9, 0.5),
        "kernel": "table",
        "kernel.path": Path("k.npy"),
    }
    cfg = compose("train", given)
    assert (cfg.grid.size, cfg.cost.sensor, cfg.kernel.path) == (
        3,
        [0.5] * 9,
        f"{Path.cwd()}/k.npy",
    )
    assert (type(cfg.grid.size), cfg.algo.total_frames) == (int, 300_000)


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"algo": "ppoo"}, "algo=ppoo: expected one of a2c, ppo, dqn"),
    ({"log": None}, "log=null: expected one of csv"),
    (
        {"algo": "hindsight", "algo.learning_rat": 1},
        "algo.learning_rat: unknown option, did you mean algo.learning_rate",
    ),
    ({"sead": 1}, "sead: unknown option, did you mean seed? (known: quiet, "),
    ({"kernel.digest": "x"}, "kernel.digest: unknown option"),  # of kernel=given
    ({"seed": "abc"}, "seed=abc: expected an integer >= 0"),
    ({"grid.size": 0}, "grid.size=0: expected an integer >= 1"),
    ({"algo": "ppo", "algo.minibatches": 3}, "algo.minibatches=3: expected a divisor"),
    ({"kernel": "table"}, "kernel.path: missing, expected a path"),
    (
        {"kernel": "given"},
        "kernel.reveals: missing, expected another choice than given, which is made",
    ),
    (
        {"sensor": "given"},
        "sensor.wide: missing, expected another choice than given, which is made",
    ),
    (
        {"algo": "a2c", "algo.credit": "per_sensor"},
        "algo.credit: renamed, expected algo=a2c_per_sensor",
    ),
    ({"kernel.homogeneous": True}, "kernel.homogeneous: renamed, expected algo.share_cells"),
    ({"lr": 0.5}, "lr: renamed, expected algo.learning_rate"),
    (
        {"log": "mcap", "log.layout": True},
        "log.layout: unknown option, did you mean log.mcap.layout?",
    ),
    (
        {"algo": "hindsight", "algo.explore.until": 0.3},
        "algo.explore.until=0.3: without effect with algo.collect=all_on",
    ),
    (
        {"algo": "dqn", "algo.prioritized.beta": 1},
        "algo.prioritized.beta=1: without effect with algo.prioritized",
    ),
    (
        {"algo": "model_based", "algo.warm_up": 1},
        "algo.warm_up=1: without effect with algo.sensing=null",
    ),
    ({"grid.cell": 10}, "grid.cell=10: without effect without grid.origin"),
    (
        {"kernel.support_size": 1, "kernel.low_probability": 0.2},
        "kernel.low_probability=0.2: without effect with support_size=1",
    ),
    ({"algo.lr": 0.5}, "algo.lr: renamed, expected algo.learning_rate"),
    ({"grid": 5}, "grid=5: expected grid.size=value"),
    ({"grid.size": {}}, "grid.size={}: expected an integer >= 1"),
    ({"algo.epocs": {}}, "algo.epocs: unknown option, did you mean algo.epochs"),
]


@pytest.mark.parametrize(("overrides", "message"), REFUSED)
def test_what_is_not_allowed_is_one_line(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        compose("train", overrides)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_what_only_training_reads_is_refused_elsewhere() -> None:
    with pytest.raises(
        UserError, match=r"log\.mcap\.evaluations=2: without effect outside training"
    ):
        compose("evaluate", {"baseline": "qmdp", "log": "mcap", "log.mcap.evaluations": 2})
    assert (
        compose("evaluate", {"baseline": "qmdp", "log": "mcap", "log.mcap.layout": True})
        .log["mcap"]
        .layout
    )


@pytest.mark.parametrize(
    ("algo", "size", "frames", "per_batch", "envs"),
    [
        ("model_based", 10, 300_000, 10_000, 1_000),
        ("model_based", 70, 1_470_000, 10_000, 1_000),
        ("model_based", 110, 3_630_000, 20_000, 2_000),
        ("model_based", [300, 300], 27_000_000, 90_000, 9_000),
        ("hindsight", 10, 300_000, 10_000, 1_000),
        ("hindsight", 128, 49_152_000, 20_000, 2_000),
    ],
)
def test_batches_grow_with_the_grid(
    algo: str, size: Any, frames: int, per_batch: int, envs: int
) -> None:
    cfg = compose("train", {"algo": algo, "grid.size": size, "grid.window": 2})
    found = cfg.collector
    assert (found.total_frames, found.frames_per_batch, found.envs) == (frames, per_batch, envs)
