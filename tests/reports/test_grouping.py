"""Runs in groups, labels by the options that differ, and the tables of both."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import pytest

from tests.helpers import train_config
from trackmdp.config import to_dict
from trackmdp.config.tree import flatten
from trackmdp.reports.grouping import study
from trackmdp.reports.results import FIGURES, FinishedRun
from trackmdp.reports.summaries import groups_table, outcome_table, runs_table
from trackmdp.reports.tables import Cell, Table


@functools.cache
def composed(*overrides: str) -> dict[str, Any]:
    return flatten(to_dict(train_config(*overrides)))


def run(
    name: str, *overrides: str, options: dict[str, Any] | None = None, **figures: float
) -> FinishedRun:
    """A run with its figures; `options` are put into its config as they are."""
    settings = composed(*overrides) | (options or {})
    return FinishedRun(name, settings, dict.fromkeys(FIGURES, None) | figures)


def paper_world(support_size: int, cost: float) -> dict[str, Any]:
    return {"kernel.support_size": support_size, "kernel.seed": support_size, "cost.sensor": cost}


def test_labels_name_the_world_and_the_algorithm() -> None:
    runs = [
        run(f"{z}{c}{algo}{s}", f"algo={algo}", options=paper_world(z, c) | {"seed": s})
        for z in (5, 3)
        for c in (0.22, 0.16)
        for algo in ("ppo", "hindsight", "a2c")
        for s in (1, 0)
    ]
    found = study(runs)
    assert found.worlds == [
        "Z=3, c=0.16",
        "Z=3, c=0.22",
        "Z=5, c=0.16",
        "Z=5, c=0.22",
    ]  # kernel.seed follows Z
    assert found.methods == ["a2c", "hindsight", "ppo"]
    assert [r.name for r in found.of("Z=5, c=0.22", "ppo")] == ["50.22ppo0", "50.22ppo1"]


def test_an_option_that_differs_is_named_once() -> None:
    runs = [
        run(f"{t}{g}", options={"grid.t_max": t, "algo.gamma": g, "threads": t + 1})
        for t in (0, 1)
        for g in (0.7, 0.9)
    ]
    found = study(runs)
    assert found.worlds == ["Z=5, c=0.16, T_max=0", "Z=5, c=0.16, T_max=1"]
    assert found.methods == ["model_based, gamma=0.7", "model_based, gamma=0.9"]


def test_a_seed_counts_once_options_that_change_no_policy_tell_its_runs_apart() -> None:
    runs = [
        run(f"{s}{e}{t}", options={"seed": s, "evaluation.every": e, "threads": t})
        for s, e, t in ((0, 1, 1), (0, 2, 1), (1, 1, 1), (1, 2, 1), (2, 1, 4))
    ]
    found = study(runs)  # threads tell no runs of one seed apart
    assert found.methods == ["model_based, evaluation.every=1", "model_based, evaluation.every=2"]
    assert [[r.seed for r in group] for group in found.groups.values()] == [[0, 1, 2], [0, 1]]


def test_runs_that_start_from_the_weights_of_others_are_a_method_of_their_own() -> None:
    fresh, from_own, from_one = (None, None), ("/s0", "/s1"), ("/s0", "/s0")
    for sources in (from_own, from_one):
        runs = [
            run(f"{s}{start[s]}", "algo=a2c", options={"seed": s, "init_from": start[s]})
            for start in (fresh, sources)
            for s in (0, 1)
        ]
        found = study(runs)
        assert found.methods == ["a2c, init_from=a run", "a2c"]
        assert [[r.seed for r in group] for group in found.groups.values()] == [[0, 1], [0, 1]]
    twice = [run(start, "algo=a2c", options={"init_from": start}) for start in ("/s0", "/s1")]
    assert study(twice).methods == ["a2c, init_from=/s0", "a2c, init_from=/s1"]


def test_options_that_go_together_are_named_by_one_of_them() -> None:
    runs = [run(str(frames), f"algo.total_frames={frames}") for frames in (20_000, 40_000)]
    assert study(runs).methods == [
        "model_based, total_frames=20000",
        "model_based, total_frames=40000",
    ]


def test_another_draw_of_the_kernel_is_another_world() -> None:
    found = study([run(str(seed), options={"kernel.seed": seed}) for seed in (1, 2)])
    assert found.worlds == ["Z=5, c=0.16, seed=1", "Z=5, c=0.16, seed=2"]


def test_lists_of_prices_that_read_alike_are_worlds_of_their_own() -> None:
    prices = ([0.1] * 9, [0.4] * 9, 0.16, 0.16 + 1e-9)
    found = study([run(str(c), options={"cost.sensor": c}) for c in prices])
    lists = ["Z=5, c=a list of 9", "Z=5, c=a list of 9 (2)"]
    assert found.worlds == ["Z=5, c=0.16", "Z=5, c=0.16 (2)", *lists]
    assert [group[0].name for group in found.groups.values()][2:] == [str(c) for c in prices[:2]]


def test_kernels_without_support_size_are_named_by_their_name() -> None:
    found = study([run("a", "kernel=random_walk"), run("b", "kernel=drift")])
    assert [world.split(",")[0] for world in found.worlds] == ["drift", "random_walk"]


EARNED = {"expected_length": 200.0, "frames": 1.0, "wall_seconds": 1.0, "cpu_seconds": 1.0}


def column(table: Table, label: str) -> list[Cell]:
    place = [column.label for column in table.columns].index(label)
    return [row[place] for row in table.rows]


def test_regret_is_to_the_best_upper_bound_that_any_run_of_the_world_has_proved() -> None:
    proved = (
        {"optimal_upper": 100.0, "optimal_lower": 99.0},
        {"optimal_upper": 99.5, "optimal_lower": 99.2},
    )
    runs = [
        run(str(seed), options={"seed": seed}, aihtr=aihtr, **EARNED, **bounds)
        for seed, (aihtr, bounds) in enumerate(zip((90.0, 99.0), proved, strict=True))
    ]
    found = study(runs)
    (world,) = found.worlds
    assert (found.upper(world), found.best(world)) == (99.5, 99.2)
    assert found.regrets("model_based") == [pytest.approx([9.5 / 200, 0.5 / 200])]
    assert found.bracket(world) == pytest.approx(0.3 / 200)  # 99.2 is attained, 99.5 may be
    table = runs_table(found)
    assert column(table, "regret per step") == pytest.approx([9.5 / 200, 0.5 / 200])
    assert column(table, "regret per step to the best known") == pytest.approx(
        [9.2 / 200, 0.2 / 200]
    )
    assert f"not certified: {world} by 0.0015" in outcome_table(found, None).caption


def test_methods_that_ran_in_other_worlds_are_named_beside_their_means() -> None:
    pairs = (("a2c", 0.1), ("a2c", 0.2), ("ppo", 0.2))
    figures = {"aihtr": 1.0, **EARNED}
    runs = [run(f"{a}{c}", f"algo={a}", options={"cost.sensor": c}, **figures) for a, c in pairs]
    assert "not in all worlds: ppo 1 of 2" in outcome_table(study(runs), None).caption
    assert "not in all worlds" not in outcome_table(study(runs[:2]), None).caption


def test_the_figures_of_a_reference_are_those_of_one_policy() -> None:
    """Two searches of different lengths: the policy of the longer one earns more, and senses less."""
    short = {"aihtr": 98.0, "accuracy": 0.95, "sensors_per_step": 3.0}
    longer = {"aihtr": 99.0, "accuracy": 0.9, "sensors_per_step": 2.0}
    runs = [
        replace(
            run(str(seed), options={"seed": seed}, aihtr=97.0, optimal_upper=99.5, **EARNED),
            references={"best known": figures, "clocked bound": {"aihtr": 99.5}},
        )
        for seed, figures in enumerate((short, longer, short))
    ]
    found = study(runs)
    (world,) = found.worlds
    for key, value in longer.items():
        assert found.reference(world, "best known", key) == value
    assert found.reference(world, "clocked bound", "aihtr") == 99.5
    assert found.reference(world, "best known", "regret") == pytest.approx(0.5 / 200)
    assert math.isnan(found.reference(world, "clocked bound", "accuracy"))


def test_a_learned_policy_above_that_of_the_solver_is_the_best_known() -> None:
    found = study([run("a", aihtr=99.4, optimal_lower=99.0, optimal_upper=100.0, **EARNED)])
    assert found.best(found.worlds[0]) == 99.4


def test_the_outcome_has_the_other_policies_and_names_a_proved_optimum() -> None:
    known = {"aihtr": 99.0, "accuracy": 0.9, "sensors_per_step": 2.0}
    others = {
        "Q_MDP": known | {"aihtr": 79.0},
        "best known": known,
        "valid bound": {"aihtr": 120.0},
    }
    for upper, name in ((99.0, "optimum"), (99.5, "best known")):
        one = run("a", aihtr=98.0, accuracy=0.8, optimal_lower=99.0, optimal_upper=upper, **EARNED)
        table = outcome_table(study([replace(one, references=others)]), 0.02)
        assert column(table, "policy") == ["model_based", "Q_MDP", name]
        assert column(table, "AIHTR") == [98.0, 79.0, 99.0]
        assert column(table, "accuracy") == [80.0, 90.0, 90.0]
        missing = [(upper - aihtr) / 200 for aihtr in (98.0, 79.0, 99.0)]
        assert column(table, "regret per step") == pytest.approx(missing)
        assert column(table, "runs ≤ 0.02") == [1, None, None]


def test_on_recordings_figures_are_of_the_validation_tracks_and_others_are_called_held_out() -> (
    None
):
    one = run("a", "kernel=tracks", "kernel.path=x.csv", aihtr=9.0, held_out_aihtr=8.0, **EARNED)
    one = replace(one, references={"all on": {"held_out_aihtr": -70.0}})
    found = study([one])
    assert found.regrets("model_based") == []
    table = outcome_table(found, None)
    assert column(table, "AIHTR")[0] == 9.0
    assert column(table, "held-out AIHTR") == [8.0, -70.0]
    assert "validation tracks" in table.caption
    for made in (runs_table(found), groups_table(found, None)):
        assert (column(made, "AIHTR"), column(made, "held-out AIHTR")) == ([9.0], [8.0])
        assert "nan" not in made.html()
