"""Objects at a prompt: few lines, and in them the figures that a reader wants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from tests.notebook.objects import NAMES, objects, recorded
from trackmdp.notebook.card import MOST_LINES, NONE, WIDE, Card, clipped, decimal, percent

BATCH = {"frames_per_batch": 100, "envs": 10}


def values(shown: object) -> dict[str, str]:
    """Name -> value, of the lines of a `repr` below its title."""
    lines = repr(shown).splitlines()[1:]
    pairs = (line.strip().split("  ", 1) for line in lines)
    return {name: value.strip() for name, value in pairs}


@pytest.mark.parametrize("name", NAMES)
def test_an_object_is_shown_in_few_lines(name: str) -> None:
    lines = repr(objects()[name]).splitlines()
    assert 3 <= len(lines) <= MOST_LINES
    assert max(map(len, lines)) <= WIDE


@pytest.mark.parametrize("name", NAMES)
def test_the_first_line_is_the_class(name: str) -> None:
    found = objects()[name]
    assert repr(found).startswith(f"{type(found).__name__}: ")


def test_a_world_names_size_prices_and_motion() -> None:
    world = tm.World(
        np.eye(6) * 0.75, (2, 3), cost=np.linspace(0.1, 0.2, 6), safe_cost=0.7, t_max=2
    )
    assert repr(world).splitlines()[0] == "World: 2 x 3 cells"
    found = values(world)
    assert found["T_max"] == "2"
    assert found["price"].startswith("0.1 to 0.2 ")
    assert found["safe action"].startswith("D = 0.7,")
    assert "1 successors" in found["motion"] and "0.25" in found["motion"]


def test_limits_and_sensors_are_named_where_there_are_any() -> None:
    plain = values(tm.make_world(size=4))
    assert not {"max_steps", "memory"} & set(plain)
    found = values(tm.make_world(size=4, max_steps=1234, window=2, detection=0.9))
    assert found["max_steps"] == "1,234"
    assert "2 cells" in found["sensors"] and "p_d 0.9" in found["sensors"]
    covering = tm.World(
        np.eye(4) * 0.5, 2, cost=0.1, t_max=0, coverage=np.array([[1, 1, 0, 0], [0, 1, 1, 1]])
    )
    assert values(covering)["sensors"] == "2, each over 2 to 3 cells"


def test_a_hidden_world_names_its_modes_and_its_memory() -> None:
    world = tm.make_world("heading", size=3, memory="displacement")
    found = values(world)
    assert found["modes"] == "8, hidden"
    assert f"{world.num_keys:,}" in found["memory"]


def test_recorded_tracks_are_counted_by_their_parts() -> None:
    found = values(recorded())
    assert found["tracks"] == "1 to learn from, 1 to choose by, 1 held out"
    assert found["points"].startswith("10;")


def test_a_run_names_figures_bound_and_folder() -> None:
    run = objects()["run"]
    assert repr(run).splitlines()[0] == "Run: model_based"
    found = values(run)
    assert found["AIHTR"] == decimal(run.evaluation.aihtr)
    assert found["accuracy"] == percent(run.evaluation.accuracy)
    assert found["size"].startswith("3 x 4 cells")
    assert "4,000 frames" in found["budget"] and "seed 3" in found["budget"]
    assert decimal(run.solution.upper) in found["bound"] and "certified" in found["bound"]
    assert "memory" in found["folder"]
    assert values(objects()["in_folder"])["folder"] == str(Path("runs") / "<a & b>")


def test_a_run_on_recorded_tracks_has_neither_bound_nor_regret() -> None:
    found = values(tm.train(recorded(), "model_based", total_frames=200, **BATCH))
    assert not {"bound", "regret per step"} & set(found)
    assert found["sensors per step"] != NONE


def test_a_solution_names_its_bracket_and_whether_it_is_closed() -> None:
    solution = objects()["solution"]
    found = values(solution)
    assert found["optimal AIHTR"] == decimal(solution.lower, 4)
    assert found["upper bound"].startswith(f"{decimal(solution.upper, 4)}; certified")
    apart = replace(solution, bound=solution.bound + 2.0, certified=False)
    found = values(apart)
    assert found["best known AIHTR"] == decimal(solution.lower, 4)
    assert "not closed" in found["upper bound"]
    assert "optimal" not in repr(apart)


def test_a_mixture_names_its_corners_with_their_probabilities() -> None:
    mixture = objects()["mixture"]
    found = values(mixture)
    assert found["accuracy"] == "90.00 %"
    assert len(mixture.parts) == 2
    for weight, corner in mixture.parts:
        place = found[f"with probability {weight:.4f}"]
        assert f"price {corner.price:g}," in place
        assert values(corner)["price of a sensor"] == f"{corner.price:g}"


def test_an_evaluation_leaves_out_start_cells_without_a_value() -> None:
    evaluation = objects()["evaluation"]
    value = evaluation.value.copy()
    low, high = decimal(value[1:].min()), decimal(value[1:].max())
    value[0] = np.nan
    assert values(replace(evaluation, value=value))["value V(x)"] == f"{low} to {high}"
    assert "value V(x)" not in values(replace(evaluation, value=value * np.nan))


def test_episodes_are_counted_with_their_figures() -> None:
    episodes = objects()["episodes"]
    assert repr(episodes).startswith("Episodes: 6 ")
    found, figures = values(episodes), episodes.figures()
    assert found["steps"] == f"{len(episodes.target):,}"
    assert found["AIHTR"].startswith(decimal(figures.aihtr.mean))
    assert found["problem"].startswith("World, 3 x 4 cells")
    assert list(values(tm.simulate(objects()["world"], "qmdp", 0))) == ["problem", "steps"]


def test_a_policy_names_the_sensors_on_after_each_miss() -> None:
    world = tm.World(np.eye(4) * 0.5, 2, cost=0.1, t_max=1)
    table = np.zeros((4, 2, 4), dtype=bool)
    table[:, 0, 0] = True
    table[0, 1, :2] = True
    policy = tm.Policy.from_dense(world, table)
    found = values(policy)
    assert found["sensors on at n = 0"] == "1.00 of 4"
    assert found["sensors on at n = 1"] == "0.50 of 4"
    assert found["choice"] == "deterministic"
    assert "exactly 3" in values(tm.Policy.random_k(world, 3))["choice"]


def test_a_long_policy_is_cut() -> None:
    world = tm.make_world(size=3, t_max=12)
    assert len(repr(tm.Policy.none(world)).splitlines()) == MOST_LINES


def test_a_long_value_keeps_both_ends_in_one_line() -> None:
    assert clipped("a\nb", 10) == "a b"
    assert clipped("\x1b[2J", 10) == "\\x1b[2J"  # the name of somebody's folder or run
    assert clipped("abcdefgh", 5) == "ab…gh"
    card = Card("x" * 300, {"folder": "/home/" + "y" * 200 + "/runs/a"})
    lines = card.text().splitlines()
    assert max(map(len, lines)) == WIDE
    assert lines[1].startswith("  folder  /home/") and lines[1].endswith("/runs/a")
