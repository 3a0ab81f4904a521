"""Solvers that simplify: FCR and look-ahead."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from tests.solvers.worlds import all_plans, followed, paper_world, tiny_worlds
from trackmdp.solvers import lookahead, optimal, rules
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import World


def line_world(price: float, t_max: int) -> World:
    """From cell 0 to 1 (0.6) or 2 (0.3); from 1 and 2 to 3; from 3 to 0; exit 0.1 everywhere."""
    kernel = np.zeros((4, 4))
    kernel[0, 1], kernel[0, 2] = 0.6, 0.3
    kernel[1, 3] = kernel[2, 3] = kernel[3, 0] = 0.9
    return World(kernel, 2, cost=np.full(4, price), safe_cost=4 * price, t_max=t_max)


def test_fcr_by_hand() -> None:
    """From 0: step 1 has 0.6 at 1 and 0.3 at 2; step 2 has 0.81 at 3; step 3 has 0.729 at 0, misses or not."""
    chains = rules.fcr(line_world(0.5, 2))
    assert [np.flatnonzero(on).tolist() for on in chains.dense()[0]] == [[1], [3], [0]]
    chains = rules.fcr(line_world(0.75, 2))
    assert [np.flatnonzero(on).tolist() for on in chains.dense()[0]] == [[], [3], []]
    in_grid = rules.fcr(line_world(0.75, 2), in_grid=True)
    assert [np.flatnonzero(on).tolist() for on in in_grid.dense()[0]] == [[], [3], [0]]


def test_fcr_takes_no_notice_of_misses_and_qmdp_does() -> None:
    """From 0 with cell 1 sensed at 0.5, a miss leaves cell 2 only, which cannot be at 1 next."""
    world = line_world(0.5, 1)
    kernel = world.kernel.toarray()
    kernel[1] = [0.0, 0.9, 0.0, 0.0]
    world = World(kernel, 2, cost=world.cost, safe_cost=world.safe_cost, t_max=1)
    assert np.flatnonzero(rules.fcr(world).dense()[0, 1]).tolist() == [1]
    assert np.flatnonzero(rules.qmdp(world).dense()[0, 1]).tolist() == [3]


@given(tiny_worlds(most_t_max=2))
def test_one_set_ahead_is_qmdp_or_the_clocked_policy(world: World) -> None:
    """But for ties, which the value does not see."""
    for tail, other in (
        ("qmdp", rules.qmdp(world, in_grid=True)),
        ("clocked", rules.clocked_policy(world)),
    ):
        ahead = lookahead.solve(world, depth=1, tail=tail)
        np.testing.assert_allclose(
            evaluate(world, ahead).value, evaluate(world, other).value, rtol=1e-9, atol=1e-9
        )


def test_a_unit_of_rewards_changes_no_plan_ahead() -> None:
    """A factor of 2^-30 changes the exponents of floats alone."""
    world, unit = paper_world(5, 0.22, 2), 2.0**-30
    paid = {name: getattr(world, name) * unit for name in ("cost", "safe_cost", "reward")}
    one, other = (lookahead.solve(each) for each in (world, world.but(**paid)))
    assert (one.dense() == other.dense()).all()


@pytest.mark.parametrize(("depth", "expected"), [(2, 88.99323840082147), (3, 90.48447404404875)])
def test_sets_ahead_close_the_gap(depth: int, expected: float) -> None:
    """Z = 5, c = 0.22, t_max = 2: the clocked policy earns -23.8; planned to the safe action, the optimum 90.4845."""
    world = paper_world(5, 0.22, 2)
    earned = evaluate(world, lookahead.solve(world, depth=depth, tail="clocked")).aihtr
    assert earned == pytest.approx(expected, abs=1e-9)
    assert evaluate(world, rules.clocked_policy(world)).aihtr < -23.0
    assert earned <= optimal.solve(world).upper


def test_depth_beyond_the_safe_action_changes_nothing() -> None:
    world = paper_world(5, 0.22, 1)
    np.testing.assert_array_equal(
        lookahead.solve(world, depth=2).dense(), lookahead.solve(world, depth=9).dense()
    )


@settings(max_examples=25)
@given(tiny_worlds(most_t_max=1))
def test_planning_to_the_safe_action_is_best_for_the_tail_it_counts_on(world: World) -> None:
    """Every pair of sets tried from every cell: none earns more, being located counted as U(j, 0)."""
    table = clocked_table(world).table[:, 0]
    planned = lookahead.solve(world, depth=world.num_choices).dense()
    for x in range(world.num_cells):
        earned, located, _ = all_plans(world, x)
        best = float((earned + located @ table).max())
        earned, located, _ = followed(world, x, list(planned[x][:, None]))
        worth = (earned + located @ table)[0]
        assert worth == pytest.approx(best, abs=1e-8 * (1.0 + abs(best)))
