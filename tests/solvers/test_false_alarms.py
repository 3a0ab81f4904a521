"""Policies that believe false reports: exact by pairs, against playing them step by step, and by hand."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.helpers import later, random_kernel, small_world
from trackmdp.app.cli import main
from trackmdp.arrays.types import Array
from trackmdp.episodes.filtered import _declared, _posterior, simulate_filter
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.false_alarms import believed
from trackmdp.world.group import Group
from trackmdp.world.make import make_world
from trackmdp.world.model import World


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


def _played(
    world: World, table: np.ndarray, p_f: float, episodes: int, rng: np.random.Generator
) -> Array:
    """`[episodes]` returns, every sensor's report drawn and the likeliest reported cell believed."""
    kernel, m = world.kernel.toarray(), world.num_cells
    likely, mass = [], np.eye(m)
    for n in range(world.num_choices):
        likely.append(mass @ kernel)
        mass = likely[n] * (1 - table[:, n] * world.detection)
    target = rng.integers(m, size=episodes)
    believes, misses, total, alive = (
        target.copy(),
        np.zeros(episodes, int),
        np.zeros(episodes),
        np.ones(episodes, bool),
    )
    each = np.arange(episodes)
    while alive.any():
        target = (
            rng.random(episodes)[:, None] > kernel.cumsum(axis=1)[np.minimum(target, m - 1)]
        ).sum(axis=1)
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


def _best(world: World, p_f: float, after: Array, belief: Array, n: int) -> float:
    """What the best tree of reports earns from an unnormalised belief, n steps after the safe action.

    Every set, every outcome of its sensors, and the best that can follow it; `after` is what follows the next safe
    action, which alone confirms.
    """
    moved = belief @ world.kernel.toarray()
    if n == world.num_choices:
        return float(moved @ (world.reward + after) - world.safe_cost * moved.sum())
    worths = []
    for chosen in itertools.product([False, True], repeat=world.num_cells):
        on = np.flatnonzero(chosen)
        worth = (
            world.reward * (moved * world.detection)[on].sum() - world.cost[on].sum() * moved.sum()
        )
        for told in itertools.product([0, 1], repeat=len(on)):
            chance = np.full((len(on), world.num_cells), p_f)
            chance[np.arange(len(on)), on] = world.detection[on]
            likely = np.where(np.array(told, dtype=bool)[:, None], chance, 1 - chance).prod(axis=0)
            worth += _best(world, p_f, after, moved * likely, n + 1)
        worths.append(worth)
    return max(worths)


@pytest.mark.parametrize(("seed", "t_max"), [(2, 0), (3, 1), *later([(2, 1)])])
def test_the_bound_holds_for_the_best_trees_of_reports(seed: int, t_max: int) -> None:
    """Two cells, whose optimum is found by value iteration; the more false alarms, the less it is worth."""
    rng = np.random.default_rng(seed)
    world = World(
        random_kernel(rng, 2, 0.4), (1, 2), cost=0.25, t_max=t_max, detection=0.9, safe_cost=0.4
    )
    bound, best = bounds.valid(world), []
    for p_f in (0.0, 0.1, 0.3):
        value = np.zeros(2)
        for _ in range(20):
            value = np.array([_best(world, p_f, value, start, 0) for start in np.eye(2)])
        assert (value <= bound + 1e-9).all()
        best.append(value.mean())
    assert (np.diff(best) <= 1e-9).all()
    # With a single free choice before the safe action nothing is left to be learned from a report.
    assert (best[0] > best[-1] + 1e-3) == (t_max > 0)
    played = simulate_filter(world, 0.1, 2000).intervals(np.arange(2000))["aihtr"]
    assert played.low is not None
    assert played.low <= bound.mean()


@pytest.mark.parametrize(
    "more", [{}, {"budget": 1}, {"cost": np.where(np.arange(16) % 5, 0.2, np.nan)}]
)
def test_the_filter_without_false_alarms_is_the_clocked_policy(more: dict[str, Any]) -> None:
    """Then a report is certain, and what is left of the belief after a miss is what the policy takes it for."""
    world = replace(small_world(4, exit_probability=0.05), detection=np.full(16, 0.9), **more)
    exact, played = evaluate(world, rules.clocked_policy(world)), simulate_filter(world, 0.0, 4000)
    error = played.totals[:, 0].std() / 4000**0.5
    assert abs(played.totals[:, 0].mean() - exact.aihtr) <= 3 * error
    found = played.intervals(np.arange(4000))
    assert found["accuracy"].mean == pytest.approx(exact.accuracy, abs=0.006)
    assert found["sensors_per_step"].mean == pytest.approx(exact.sensors_per_step, abs=0.1)
    assert played.watched.sum() == played.totals[:, 3].sum()
    again = simulate_filter(world, 0.0, 4000)
    assert (again.totals == played.totals).all()


def test_a_report_is_weighed_against_the_others_silence() -> None:
    """Sensors 0 and 1 are on, 1 reports: at 0 missed and falsely reported, .2 · .1; at 1 .9 · .8; at 2 .9 · .1."""
    world = World(np.eye(3) * 0.5, (1, 3), cost=0.1, t_max=0, detection=0.8)
    on, told = np.array([[True, True, False]]), np.array([[False, True, False]])
    found = _posterior(world, np.array([[0.25, 0.15, 0.1]]), on, told, 0.1)
    likely = np.array([0.25 * 0.2 * 0.1, 0.15 * 0.9 * 0.8, 0.1 * 0.9 * 0.1])
    assert found[0] == pytest.approx(likely / likely.sum())


def test_the_likeliest_report_is_declared_where_that_is_worth_more_than_a_miss() -> None:
    """Belief .5 .3 .2, reports from cells 1 and 2: .3 for declaring cell 1, and what is lost by it, .2 or .4."""
    belief, told = (
        np.array([[0.5, 0.3, 0.2]] * 3),
        np.array([[False, True, True]] * 2 + [[False] * 3]),
    )
    later = np.array([[-0.2] * 3, [-0.4] * 3, [0.2] * 3])
    declared, cell = _declared(1.0, belief, told, later)
    assert declared.tolist() == [True, False, False]
    assert cell[0] == 1


def test_weighing_reports_is_no_worse_than_believing_them() -> None:
    """Each report has the r that believing it would have; what it tells of the others' silence comes on top."""
    given = make_world("random_support", size=4, support_size=5, cost=0.16, t_max=1, seed=100)
    world = World.of(given, given.kernel, detection=np.full(16, 0.95))
    played = simulate_filter(world, 0.05, 1000).totals[:, 0]
    exact = evaluate(world, rules.clocked_policy(world), false_alarm=0.05).aihtr
    assert played.mean() - exact > 2 * played.std() / 1000**0.5


def test_a_large_system_is_iterated_to_the_same_value(monkeypatch: pytest.MonkeyPatch) -> None:
    world = small_world(4)
    policy = PolicyTable.from_dense(world, np.random.default_rng(0).random((16, 2, 16)) < 0.3)
    direct = believed(world, policy, 0.05)
    monkeypatch.setattr("trackmdp.solvers.false_alarms._DIRECT", 10)
    iterated = believed(world, policy, 0.05)
    assert iterated.error < 1e-8
    assert iterated.value == pytest.approx(direct.value, abs=iterated.error + 1e-12)


def test_what_has_no_exact_value_is_refused() -> None:
    world = small_world()
    policy = PolicyTable.all_on(world)
    remembers = replace(world, memory="displacement")
    keyed = PolicyTable(remembers, PolicyTable.all_on(remembers).written)
    for given, told in (
        ((replace(world, max_steps=5), policy, 0.1), "whole episodes"),
        ((replace(world, safe_detection=0.5), policy, 0.1), "a safe action that always locates"),
        ((world, PolicyTable(world, probability=0.5), 0.1), "does not draw"),
        ((world, keyed, 0.1), "the cell alone"),
        ((world, policy, 1.0), "expected a probability below 1"),
        (
            (small_world(13), PolicyTable.all_on(small_world(13)), 0.1),
            "at most 144 cells",
        ),
    ):
        with pytest.raises(UserError, match=told):
            believed(*given)
    with pytest.raises(UserError, match=r"false_alarm=0.1: expected 0 with several targets"):
        evaluate(Group([world] * 2), policy, false_alarm=0.1)  # type: ignore[call-overload]


def test_the_command_values_a_baseline_and_a_trained_policy(tmp_path: Path) -> None:
    words = ["sensor=false_alarm", "sensor.p_f=.02", "quiet=true", "episodes=50"]
    assert (
        main(
            [
                "evaluate",
                "baseline=clocked",
                "grid.size=4",
                *words,
                f"hydra.run.dir={tmp_path / 'a'}",
            ]
        )
        == 0
    )
    told = json.loads((tmp_path / "a" / "evaluation.json").read_text())
    assert (
        told["exact"]["aihtr"]
        < told["without_false_alarms"]["aihtr"]
        <= told["bounds"]["valid"] + 1e-9
    )
    filtered = told["filter"]
    assert filtered["aihtr"]["low"] < told["bounds"]["valid"]
    ratio = filtered["aihtr"]["mean"] / filtered["reward_per_step"]["mean"]
    assert ratio == pytest.approx(told["exact"]["expected_length"])
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
    assert (
        main(
            [
                "evaluate",
                f"run={tmp_path / 'b'}",
                *words,
                "episodes=0",
                f"hydra.run.dir={tmp_path / 'c'}",
            ]
        )
        == 0
    )
    told = json.loads((tmp_path / "c" / "evaluation.json").read_text())
    assert (told["p_f"], told["filter"]) == (0.02, None)


@pytest.mark.parametrize("more", [[], ["grid.window=1"]])
def test_the_table_has_a_filter_where_one_is_simulated(
    more: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """In a window there is none: it is about the last located cell, and the filter is never sure of one."""
    words = ["baseline=clocked", "sensor=false_alarm", "grid.size=3", "episodes=20", *more]
    assert main(["evaluate", *words, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert ("Bayes" in capsys.readouterr().out) != bool(more)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["solve"],
            "sensor=false_alarm: expected perfect, miss or footprint; policies are evaluated with false alarms",
        ),
        (["train"], "sensor=false_alarm: expected perfect, miss or footprint"),
        (
            ["evaluate", "baseline=clocked", "sensor.p_f=1"],
            "sensor.p_f=1: expected a number >= 0 and < 1",
        ),
        (
            ["evaluate", "baseline=clocked", "log=[mcap]"],
            "log=[mcap]: expected [] with sensor=false_alarm",
        ),
    ],
)
def test_commands_that_refuse_false_alarms(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    command, *rest = words
    assert (
        main(
            [
                command,
                "sensor=false_alarm",
                "grid.size=4",
                *rest,
                f"hydra.run.dir={tmp_path / 'run'}",
            ]
        )
        != 0
    )
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert told in lines[0]
