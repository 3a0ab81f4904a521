"""The belief-state solver: Theorem 2 with nothing in common with the solver on chains."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from tests.solvers.worlds import best_of_all, tiny_worlds
from trackmdp.errors import UserError
from trackmdp.solvers import optimal, pomdp
from trackmdp.world.make import make_world
from trackmdp.world.model import World


@settings(max_examples=15)
@given(tiny_worlds(most_t_max=2))
def test_the_same_optimum_as_on_chains(world: World) -> None:
    chains = optimal.solve(world, tolerance=1e-9)
    scale = 1.0 + np.abs(chains.value).max()
    np.testing.assert_allclose(pomdp.solve(world).value, chains.value, rtol=0, atol=1e-8 * scale)


@settings(max_examples=10)
@given(tiny_worlds(most_t_max=1))
def test_the_same_optimum_as_by_brute_force(world: World) -> None:
    np.testing.assert_allclose(pomdp.solve(world).value, best_of_all(world), rtol=1e-8, atol=1e-8)


def test_a_safe_action_that_nobody_would_take_may_cost_anything() -> None:
    """Beside a large D the margin of a better choice stays that of the numbers compared."""
    world = make_world("random_support", size=3, support_size=3, cost=0.22)
    dear, dearest = (pomdp.solve(world.but(safe_cost=price)).value for price in (1e2, 1e12))
    np.testing.assert_allclose(dearest, dear, rtol=1e-12)


def test_belief_states_are_counted_once() -> None:
    """Two cells that swap and exit with 1/2: after a miss the position is known, so per n there are two beliefs."""
    kernel = np.zeros((4, 4))
    kernel[0, 1] = kernel[1, 0] = kernel[2, 3] = kernel[3, 2] = 0.5
    world = World(kernel, 2, cost=np.full(4, 0.1), safe_cost=0.4, t_max=1)
    assert pomdp.solve(world).beliefs == 4 * 3


def test_too_many_beliefs_are_refused() -> None:
    world = World(
        np.random.default_rng(0).random((4, 4)) / 5, 2, cost=np.full(4, 0.1), safe_cost=0.4, t_max=2
    )
    with pytest.raises(UserError, match="more than 100 belief states"):
        pomdp.solve(world, most_beliefs=100)
