"""The exact value of a policy given as chains of sets."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.solvers.worlds import REFERENCES, reference_world, renewal, tiny_worlds, value_of
from trackmdp.errors import UserError
from trackmdp.solvers import qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.solvers.renewal import expected_steps
from trackmdp.world.model import World


@given(tiny_worlds(most_t_max=2), st.integers(0, 2**32 - 1))
def test_the_value_is_that_of_stepping_through_the_chains(world: World, seed: int) -> None:
    chains = np.random.default_rng(seed).random((world.num_cells, world.num_choices, world.num_cells)) < 0.4
    np.testing.assert_allclose(evaluate(world, chains).value, value_of(world, chains), rtol=1e-9, atol=1e-9)


@given(tiny_worlds(most_t_max=1), st.integers(0, 2**32 - 1))
def test_probabilities_average_over_independent_sensors(world: World, seed: int) -> None:
    """One sensor of one chain at probability p: the value of a renewal is linear in p, so V solves the mixed system."""
    rng = np.random.default_rng(seed)
    base = rng.random((world.num_cells, world.num_choices, world.num_cells)) < 0.4
    x, j, p = int(rng.integers(world.num_cells)), int(rng.integers(world.num_cells)), float(rng.random())
    off, on, mixed = base.copy(), base.copy(), base.astype(float)
    off[x, 0, j], on[x, 0, j], mixed[x, 0, j] = False, True, p
    value = evaluate(world, mixed).value
    backup = [_backup(world, chains, x, value) for chains in (off, on)]
    np.testing.assert_allclose((1 - p) * backup[0] + p * backup[1], value[x], rtol=1e-9, atol=1e-9)


def _backup(world: World, chains: np.ndarray, x: int, value: np.ndarray) -> float:
    earned, located = renewal(world, x, chains[x])
    return earned + float(located @ value)


@pytest.mark.parametrize("reference", REFERENCES, ids=lambda row: row["name"])
def test_counts_agree_with_the_reference(reference: dict) -> None:
    world = reference_world(reference)
    result = evaluate(world, qmdp.solve(world))
    assert result.accuracy == pytest.approx(reference["qmdp_accuracy"], abs=1e-9)
    np.testing.assert_allclose(result.safe_actions, reference["qmdp_safe_actions"], atol=1e-9)
    assert result.safe_per_episode == pytest.approx(np.mean(reference["qmdp_safe_actions"]), abs=1e-9)


def test_a_world_by_hand() -> None:
    """Two cells matter: the target hops 0 -> 1 -> 0 and exits with probability 1/2 each step; sense nothing, t_max = 0.

    From either cell: a miss in the grid (1/2), then the forced step (1/4, located). Renewals: 1 / (1 - 1/4).
    """
    kernel = np.zeros((4, 4))
    kernel[0, 1] = kernel[1, 0] = 0.5
    world = World(kernel, 2, cost=np.array([0.1, 0.2, 0.3, 0.4]), safe_cost=1.0, t_max=0, reward=3.0)
    result = evaluate(world, np.zeros((4, 1, 4), dtype=bool))
    renewals = 4 / 3
    np.testing.assert_allclose(result.value, [renewals * 0.25 * 2.0] * 2 + [0.0] * 2)
    np.testing.assert_allclose(result.steps, [renewals * 0.75] * 2 + [0.0] * 2)
    np.testing.assert_allclose(result.safe_actions, [renewals * 0.25] * 2 + [0.0] * 2)
    assert result.accuracy == pytest.approx(1 / 3)
    assert result.expected_length == pytest.approx((2 + 2 + 1 + 1) / 4)
    assert regret_per_step(result.aihtr + 0.3, result) == pytest.approx(0.2)
    sensing = np.zeros((4, 1, 4), dtype=bool)
    sensing[0, 0, 1] = sensing[1, 0, 0] = True
    always = evaluate(world, sensing)
    np.testing.assert_allclose(always.value[:2], np.linalg.solve([[1, -0.5], [-0.5, 1]], [0.5 * 2.8, 0.5 * 2.9]))
    assert always.accuracy == 1.0
    assert always.sensors_per_step == pytest.approx(1.0)


def test_a_kernel_that_never_exits_has_no_value() -> None:
    world = World(np.full((4, 4), 0.25), 2, cost=0.1, t_max=1, max_steps=9)
    with pytest.raises(UserError, match="never exits"):
        expected_steps(world)


def test_chains_of_another_world_are_refused() -> None:
    world = World(np.full((4, 4), 0.2), 2, cost=np.full(4, 0.1), safe_cost=0.4, t_max=1)
    with pytest.raises(UserError, match=r"expected shape \(4, 2, 4\)"):
        evaluate(world, np.zeros((4, 1, 4), dtype=bool))
    with pytest.raises(UserError, match="between 0 and 1"):
        evaluate(world, np.full((4, 2, 4), 1.5))
