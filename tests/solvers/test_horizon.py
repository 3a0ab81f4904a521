"""Episodes cut after a number of steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers import hop_world, limited, small_world
from tests.solvers.worlds import tiny_worlds
from trackmdp.solvers import bounds
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import BoolArray, World


def by_recursion(world: World, sets: BoolArray, start: int, steps: int) -> float:
    """Expected reward of `steps` steps from a detection in `start`, by walking through every state."""

    def value(last: int, n: int, cell: int, left: int) -> float:
        if left == 0:
            return 0.0
        total = 0.0
        for following in range(world.num_cells):
            p = world.kernel[cell, following]
            if p == 0.0:
                continue
            if n > world.t_max:
                total += p * (world.reward - world.safe_cost + value(following, 0, following, left - 1))
            elif sets[last, n, following]:
                price = world.cost[sets[last, n]].sum()
                total += p * (world.reward - price + value(following, 0, following, left - 1))
            else:
                total += p * (value(last, n + 1, following, left - 1) - world.cost[sets[last, n]].sum())
        return total

    return value(start, 0, start, steps)


@settings(max_examples=30, deadline=None)
@given(tiny_worlds(), st.integers(1, 5), st.integers(0, 2**16))
def test_value_equals_a_walk_through_every_state(world: World, steps: int, seed: int) -> None:
    shape = (world.num_cells, world.num_choices, world.num_cells)
    sets = np.random.default_rng(seed).random(shape) < 0.5
    expected = [by_recursion(world, sets, start, steps) for start in range(world.num_cells)]
    np.testing.assert_allclose(evaluate(limited(world, steps), sets).value, expected, atol=1e-12)


def test_one_step_by_hand() -> None:
    world = hop_world()
    sets = np.zeros((4, 2, 4), dtype=bool)
    sets[0, 0, 1] = True  # from cell 0 the next cell is sensed, from the others nothing is
    figures = evaluate(limited(world, 1), sets)
    np.testing.assert_allclose(figures.value, [0.75 * (2.0 - 0.2), 0.0, 0.0, 0.0])
    assert figures.expected_length == 1.0
    assert figures.accuracy == pytest.approx(0.25)


@settings(max_examples=5, deadline=None)
@given(tiny_worlds(), st.integers(0, 2**16))
def test_long_episodes_have_the_untruncated_figures(world: World, seed: int) -> None:
    sets = np.random.default_rng(seed).random((world.num_cells, world.num_choices, world.num_cells)) < 0.5
    cut, whole = evaluate(limited(world, 1500), sets), evaluate(world, sets)
    np.testing.assert_allclose(cut.value, whole.value, rtol=1e-9, atol=1e-9)
    assert cut.expected_length == pytest.approx(whole.expected_length)
    assert cut.safe_per_episode == pytest.approx(whole.safe_per_episode)
    np.testing.assert_allclose(bounds.clocked(limited(world, 1500)), bounds.clocked(world), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(bounds.valid(limited(world, 1500)), bounds.valid(world), rtol=1e-9, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(tiny_worlds(), st.integers(1, 6), st.integers(0, 2**16))
def test_no_policy_beats_the_bounds(world: World, steps: int, seed: int) -> None:
    sets = np.random.default_rng(seed).random((world.num_cells, world.num_choices, world.num_cells)) < 0.5
    value, clocked = evaluate(limited(world, steps), sets).value, bounds.clocked(limited(world, steps))
    assert (value <= clocked + 1e-9).all()
    assert (clocked <= bounds.valid(limited(world, steps)) + 1e-9).all()


def test_a_target_that_never_exits() -> None:
    world = small_world(exit_probability=0.0, max_steps=50)
    everything = np.ones((9, 2, 9), dtype=bool)
    figures = evaluate(world, everything)
    assert figures.aihtr == pytest.approx(50 * (1.0 - 9 * 0.2))
    assert figures.expected_length == pytest.approx(50.0)


def test_a_limit_that_no_episode_reaches_takes_no_longer() -> None:
    # 10^18 rounds of the recursion would have no end; it stops where its values do not change any more.
    world = small_world(exit_probability=0.1)
    everything = np.ones((9, 2, 9), dtype=bool)
    cut = limited(world, 10**18)
    assert evaluate(cut, everything).aihtr == pytest.approx(evaluate(world, everything).aihtr)
    np.testing.assert_allclose(bounds.clocked(cut), bounds.clocked(world))
    np.testing.assert_allclose(bounds.valid(cut), bounds.valid(world))
