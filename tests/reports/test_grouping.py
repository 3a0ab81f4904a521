"""Runs in groups: what tells them apart names them."""

from __future__ import annotations

import functools
from typing import Any

import pytest

from tests.helpers import train_config
from trackmdp.config import to_dict
from trackmdp.config.tree import flatten
from trackmdp.reports.grouping import study, world_key
from trackmdp.reports.results import FIGURES, FinishedRun
from trackmdp.reports.summaries import methods_table, runs_table


@functools.cache
def composed(*overrides: str) -> dict[str, Any]:
    return flatten(to_dict(train_config(*overrides)))


def run(name: str, *overrides: str, options: dict[str, Any] | None = None, **figures: float) -> FinishedRun:
    """A run with its figures; `options` are put into its config as they are."""
    settings = composed(*overrides) | (options or {})
    return FinishedRun(name, settings, dict.fromkeys(FIGURES, None) | figures, name)


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
    assert found.worlds == ["Z=3, c=0.16", "Z=3, c=0.22", "Z=5, c=0.16", "Z=5, c=0.22"]  # kernel.seed follows Z
    assert found.methods == ["a2c", "hindsight", "ppo"]
    assert [r.name for r in found.of("Z=5, c=0.22", "ppo")] == ["50.22ppo0", "50.22ppo1"]
    assert len({world_key(r) for r in runs}) == 4


def test_an_option_that_differs_is_named_once() -> None:
    runs = [
        run(f"{t}{g}", options={"grid.t_max": t, "algo.gamma": g, "threads": t + 1}) for t in (0, 1) for g in (0.7, 0.9)
    ]
    found = study(runs)
    assert found.worlds == ["Z=5, c=0.16, T_max=0", "Z=5, c=0.16, T_max=1"]
    assert found.methods == ["hindsight, gamma=0.7", "hindsight, gamma=0.9"]


def test_options_that_go_together_are_named_by_one_of_them() -> None:
    runs = [run(str(frames), f"algo.total_frames={frames}") for frames in (20_000, 40_000)]
    assert study(runs).methods == ["hindsight, buffer_size=20000", "hindsight, buffer_size=40000"]


def test_another_draw_of_the_kernel_is_another_world() -> None:
    found = study([run(str(seed), options={"kernel.seed": seed}) for seed in (1, 2)])
    assert found.worlds == ["Z=5, c=0.16, seed=1", "Z=5, c=0.16, seed=2"]


def test_kernels_without_support_size_are_named_by_their_name() -> None:
    found = study([run("a", "kernel=random_walk"), run("b", "kernel=drift")])
    assert [world.split(",")[0] for world in found.worlds] == ["drift", "random_walk"]


def test_regret_is_to_the_best_upper_bound_that_any_run_of_the_world_has_proved() -> None:
    runs = [
        run("a", options={"seed": 0}, aihtr=90.0, expected_length=200.0, bound_clocked=101.0, optimal_upper=100.0),
        run("b", options={"seed": 1}, aihtr=99.0, expected_length=200.0, bound_clocked=101.0, optimal_upper=99.5),
    ]
    runs[0].figures["optimal_lower"], runs[1].figures["optimal_lower"] = 99.0, 99.2  # type: ignore[index]
    for each in runs:
        each.figures.update(dict.fromkeys(("frames", "wall_seconds", "cpu_seconds", "accuracy"), 1.0))  # type: ignore[attr-defined]
    found = study(runs)
    (world,) = found.worlds
    assert (found.upper(world), found.lower(world)) == (99.5, 99.2)
    assert found.regrets(world, "hindsight") == pytest.approx([9.5 / 200, 0.5 / 200])
    assert found.bracket(world) == pytest.approx(0.3 / 200)  # 99.2 is attained, 99.5 may be
    table = runs_table(found)
    at = [column.label for column in table.columns].index("regret per step to the best known")
    assert [row[at : at + 2] for row in table.rows] == [
        pytest.approx([9.2 / 200, 9.5 / 200]),
        pytest.approx([0.2 / 200, 0.5 / 200]),
    ]
    assert f"not certified: {world} by 0.0015" in methods_table(found, None).caption


def test_a_learned_policy_above_the_solvers_is_the_best_known() -> None:
    found = study([run("a", aihtr=99.4, expected_length=200.0, optimal_lower=99.0, optimal_upper=100.0)])
    (world,) = found.worlds
    assert found.best(world) == 99.4


def test_without_a_bound_there_is_no_regret() -> None:
    found = study([run("a", aihtr=90.0, expected_length=200.0)])
    assert found.regrets(found.worlds[0], "hindsight") == []
