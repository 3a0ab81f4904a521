"""Policies that believe false reports: exact by pairs, against playing them step by step, and by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import random_kernel, small_world
from trackmdp.app.cli import main
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds
from trackmdp.solvers.alarms import believed
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import Array, World


def test_one_sensor_by_hand() -> None:
    """The target stays where it is with .8; sensor 0 is on. From pair (0, 0): .8 (1 · 1 - .1 + V00).

    In cell 1 sensor 0 tells nothing but a false alarm, p_f = .5, believed: no reward, and the pair (0, 1) again. From
    (0, 1) or (1, 1): .8 (-.1 + .5 V01 + .5 F), F = .8 (1 - .3 + V11); V01 = V11.
    """
    world = World(np.diag([0.8, 0.8]), (1, 2), cost=0.1, t_max=0, safe_cost=0.3)
    policy = PolicyTable.from_dense(world, np.tile([True, False], (2, 1, 1)))
    found = evaluate(world, policy, false_alarm=0.5)
    assert found.value == pytest.approx([0.72 / 0.2, 0.8 * (0.5 * 0.56 - 0.1) / (1 - 0.4 - 0.32)])


@pytest.mark.parametrize("seed", range(6))
def test_exact_values_are_those_of_playing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Three sensors of nine never miss, so that entries of probability zero occur.
    detection = np.where(np.arange(9) < 3, 1.0, 1 - 0.5 * rng.random(9))
    world = World(random_kernel(rng, 9, 0.2), 3, cost=0.1, t_max=seed % 3, detection=detection)
    table = rng.random((9, world.num_choices, 9)) < 0.4
    policy, p_f = PolicyTable.from_dense(world, table), 0.4
    exact = believed(world, policy, p_f)
    returns = _played(world, table, p_f, 20_000, rng)
    assert abs(returns.mean() - exact.aihtr) <= 3 * returns.std() / len(returns) ** 0.5
    assert exact.aihtr <= bounds.valid(world).mean()
    assert believed(world, policy, 0.0).value == pytest.approx(evaluate(world, policy).value)


def _played(world: World, table: np.ndarray, p_f: float, episodes: int, rng: np.random.Generator) -> Array:
    """`[episodes]` returns, every sensor's report drawn and the likeliest reported cell believed."""
    kernel, m = world.kernel.toarray(), world.num_cells
    likely, mass = [], np.eye(m)
    for n in range(world.num_choices):
        likely.append(mass @ kernel)
        mass = likely[n] * (1 - table[:, n] * world.detection)
    target = rng.integers(m, size=episodes)
    believes, misses, total, alive = target.copy(), np.zeros(episodes, int), np.zeros(episodes), np.ones(episodes, bool)
    each = np.arange(episodes)
    while alive.any():
        target = (rng.random(episodes)[:, None] > kernel.cumsum(axis=1)[np.minimum(target, m - 1)]).sum(axis=1)
        alive &= target < m
        place = np.minimum(target, m - 1)
        forced, n = misses > world.t_max, np.minimum(misses, world.t_max)
        on = table[believes, n]
        chance = np.full((episodes, m), p_f)
        chance[each, place] = world.detection[place]
        report = on & (rng.random((episodes, m)) < chance)
        # The first of equally likely cells, as in the sorted sets.
        told = np.where(report, np.stack(likely)[n, believes], -1.0).argmax(axis=1)
        heard = report.any(axis=1) | forced
        told = np.where(forced, place, told)
        paid = np.where(forced, world.safe_cost, (on * world.cost).sum(axis=1))
        total += alive * (world.reward * (heard & (told == place)) - paid)
        believes, misses = np.where(heard, told, believes), np.where(heard, 0, misses + 1)
    return total


def test_a_large_system_is_iterated_to_the_same_value(monkeypatch: pytest.MonkeyPatch) -> None:
    world = small_world(4)
    policy = PolicyTable.from_dense(world, np.random.default_rng(0).random((16, 2, 16)) < 0.3)
    direct = believed(world, policy, 0.05)
    monkeypatch.setattr("trackmdp.solvers.alarms._DIRECT", 10)
    iterated = believed(world, policy, 0.05)
    assert iterated.error < 1e-8
    assert iterated.value == pytest.approx(direct.value, abs=iterated.error + 1e-12)


def test_what_has_no_exact_value_is_refused() -> None:
    world = small_world()
    policy = PolicyTable.all_on(world)
    for given, told in (
        ((replace(world, max_steps=5), policy, 0.1), "whole episodes"),
        ((replace(world, safe_detection=0.5), policy, 0.1), "a safe action that always locates"),
        ((world, PolicyTable(world, probability=0.5), 0.1), "does not draw"),
        ((world, policy, 1.0), "expected a probability below 1"),
        ((small_world(13), PolicyTable.all_on(small_world(13)), 0.1), "169 cells, expected at most 144"),
    ):
        with pytest.raises(UserError, match=told):
            believed(*given)


def test_the_command_values_a_baseline_and_a_trained_policy(tmp_path: Path) -> None:
    words = ["sensor=false_alarm", "sensor.p_f=.02", "quiet=true"]
    assert main(["evaluate", "baseline=clocked", "grid.size=4", *words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    told = json.loads((tmp_path / "a" / "evaluation.json").read_text())
    assert told["exact"]["aihtr"] < told["without_false_alarms"]["aihtr"] <= told["bounds"]["valid"] + 1e-9
    learn = [
        "algo=hindsight",
        "algo.updates=2",
        "algo.total_frames=2048",
        "algo.frames_per_batch=1024",
        "grid.size=4",
        "optimal.enabled=false",
        "algo.envs=32",
    ]
    assert main(["train", *learn, "quiet=true", f"hydra.run.dir={tmp_path / 'b'}"]) == 0
    assert main(["evaluate", f"run={tmp_path / 'b'}", *words, f"hydra.run.dir={tmp_path / 'c'}"]) == 0
    assert json.loads((tmp_path / "c" / "evaluation.json").read_text())["p_f"] == 0.02


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["solve"], "sensor=false_alarm: expected perfect or miss; policies are evaluated with false alarms"),
        (["train"], "sensor=false_alarm: expected perfect or miss"),
        (["evaluate", "baseline=clocked", "sensor.p_f=1"], "sensor.p_f=1.0: expected a number >= 0 and < 1"),
        (["evaluate", "baseline=clocked", "log=[mcap]"], "log=[mcap]: expected [] with sensor=false_alarm"),
    ],
)
def test_commands_that_refuse_false_alarms(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command, *rest = words
    assert main([command, "sensor=false_alarm", "grid.size=4", *rest, f"hydra.run.dir={tmp_path / 'run'}"]) != 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert told in lines[0]
