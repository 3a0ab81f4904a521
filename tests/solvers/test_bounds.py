"""The three upper bounds, and the policies that read their sets off a threshold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from tests.solvers.worlds import (
    PAPER_REFERENCES,
    REFERENCES,
    best_of_all,
    paper_world,
    reference_world,
    tiny_worlds,
)
from trackmdp.solvers import bounds, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.several import group_bounds
from trackmdp.world.make import make_world
from trackmdp.world.model import World


@pytest.mark.parametrize("reference", REFERENCES, ids=lambda row: row["name"])
def test_reference_values(reference: dict) -> None:
    world = reference_world(reference)
    np.testing.assert_allclose(bounds.clocked(world), reference["clocked_bound"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        bounds.valid(world), reference["paper_bound_valid"], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        bounds.paper(world), reference["paper_bound_as_printed"], rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        evaluate(world, rules.qmdp(world)).value, reference["qmdp_value"], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize(
    "row",
    PAPER_REFERENCES,
    ids=lambda row: f"Z{row['support_size']}-c{row['cost']}-T{row['t_max']}",
)
def test_the_papers_worlds(row: dict) -> None:
    world = paper_world(row["support_size"], row["cost"], row["t_max"])
    assert bounds.clocked(world).mean() == pytest.approx(row["clocked_bound"], abs=1e-9)
    assert evaluate(world, rules.qmdp(world)).aihtr == pytest.approx(row["qmdp"], abs=1e-9)
    if row["cost"] != 0.22 or row["support_size"] != 5:
        assert evaluate(world, rules.clocked_policy(world)).aihtr == pytest.approx(
            row["best_known"], abs=1e-9
        )


@given(tiny_worlds())
def test_no_chain_beats_the_clocked_bound_and_it_beats_no_valid_one(world: World) -> None:
    best, bound = best_of_all(world), bounds.clocked(world)
    slack = 1e-9 * (1.0 + np.abs(bound).max())
    assert (best <= bound + slack).all()
    assert (bound <= bounds.valid(world) + slack).all()


@given(tiny_worlds(most_t_max=3))
def test_the_clocked_table_solves_its_equation(world: World) -> None:
    table = bounds.clocked_table(world).table
    kernel = world.kernel.toarray()
    sense = kernel * (world.reward + table[:, 0]) - world.cost * world.stay_probability[:, None]
    for n in range(world.num_choices):
        expected = np.maximum(sense, kernel * table[:, n + 1]).sum(axis=1)
        np.testing.assert_allclose(table[:, n], expected, rtol=1e-9, atol=1e-9)
    forced = world.kernel @ (world.reward - world.safe_cost + table[:, 0])
    np.testing.assert_allclose(table[:, -1], forced, rtol=1e-9, atol=1e-9)


def test_a_safe_action_that_nobody_would_take_may_cost_anything() -> None:
    # A margin relative to the whole table, D in it, would swallow every gain of a step.
    world = make_world("random_support", size=3, support_size=3, cost=0.22)
    dear, dearest = (bounds.clocked(world.but(safe_cost=price)) for price in (1e4, 1e12))
    np.testing.assert_allclose(dearest, dear, rtol=1e-9)


def test_the_bound_of_a_pair_holds_where_values_fall_from_round_to_round() -> None:
    """Its own equation, iterated far beyond its end."""
    world = World(
        np.array([[0.13, 0.14], [0.18, 0.0]]), (1, 2), cost=[0.98, 0.69], safe_cost=1e3, t_max=0
    )
    pair = group_bounds._Paired(world, world)
    table = np.zeros((2, 3, 2))
    for _ in range(100):
        table = pair._round(table)
    assert (pair.value >= table[:, :-1, 0]).all()
    np.testing.assert_allclose(pair.value, table[:, :-1, 0], atol=1e-5)


def test_a_tie_adds_up_over_long_episodes() -> None:
    """To leave the other cell out is better by .00016 a step: a tie beside values of 6e8, but not over 1e9 steps."""
    kernel = np.array([[0.8 - 1e-9, 0.2], [0.2, 0.8 - 1e-9]])
    world = World(kernel, (1, 2), cost=0.2, t_max=0, safe_cost=0.4 - 8e-4)
    value = evaluate(world, np.eye(2, dtype=bool)[:, None]).value
    assert value.mean() > 1.0001 * evaluate(world, "all_on").aihtr
    assert (value <= bounds.clocked(world)).all()


def test_a_probability_equal_to_the_threshold_is_sensed_whatever_its_rounding() -> None:
    kernel = np.zeros((4, 4))
    kernel[:, 1], kernel[:, 2] = 0.15, 0.6
    kernel[1, 1] = np.nextafter(0.15, 0)
    world = World(kernel, 2, cost=np.full(4, 0.15), safe_cost=0.6, t_max=0)
    assert rules.qmdp(world).dense()[:, 0].tolist() == [[False, True, True, False]] * 4
    assert (
        rules.myopic(world, threshold=0.15).dense()[:, 0].tolist()
        == [[False, True, True, False]] * 4
    )
    assert (
        rules.myopic(world, threshold=0.2).dense()[:, 0].tolist()
        == [[False, False, True, False]] * 4
    )


def test_the_in_grid_threshold_senses_what_the_printed_one_leaves() -> None:
    """From each cell p = 0.4 and 0.1 with exit 0.5: given that it stays, a sensor at 0.5 costs half as often."""
    kernel = np.zeros((4, 4))
    kernel[:, 0], kernel[:, 1] = 0.4, 0.1
    world = World(kernel, 2, cost=np.full(4, 0.5), safe_cost=2.0, t_max=0)
    assert rules.qmdp(world).dense().sum() == 0
    assert (
        rules.qmdp(world, in_grid=True).dense()[:, 0].tolist() == [[True, False, False, False]] * 4
    )


def test_costs_per_cell_set_the_threshold_per_cell() -> None:
    kernel = np.full((4, 4), 0.2)
    world = World(kernel, 2, cost=np.array([0.1, 0.3, 0.19, 0.21]), safe_cost=1.0, t_max=0)
    assert rules.qmdp(world).dense()[:, 0].tolist() == [[True, False, True, False]] * 4
