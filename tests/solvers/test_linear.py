"""Linear systems: the iteration against the factorisation, and what it says about its own error."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

import trackmdp as tm
from tests.helpers import random_kernel
from trackmdp.errors import UserError
from trackmdp.motion.kernels import random_walk
from trackmdp.solvers import linear, multigrid, renewal, rules, value
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.linear import RenewalSystem, accumulate, solve_onward
from trackmdp.solvers.motion_totals import expected_steps
from trackmdp.solvers.optimal import solve
from trackmdp.world.model import World


@settings(max_examples=25)
@given(
    st.integers(0, 2**31),
    st.integers(2, 20),
    st.integers(2, 20),
    st.sampled_from([0.3, 0.01, 1e-4]),
)
def test_the_iteration_solves_what_the_factorisation_solves(
    seed: int, rows: int, columns: int, out: float
) -> None:
    rng = np.random.default_rng(seed)
    transition = sparse.csr_array(random_kernel(rng, rows * columns, out))
    gathered = rng.standard_normal((rows * columns, 3))
    exact = np.linalg.solve(np.eye(rows * columns) - transition.toarray(), gathered)
    iterated = RenewalSystem(transition, (rows, columns), direct=0)
    assert not iterated.exact
    found = iterated.solve(gathered)
    longest = 1.0 / out
    error = iterated.error(gathered, found, longest)
    assert np.abs(found - exact).max() <= error + 1e-9
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-8 * longest)
    np.testing.assert_allclose(accumulate(transition, gathered), exact, rtol=0, atol=1e-8 * longest)
    assert (found + error >= exact - 1e-12 * longest).all()


@pytest.mark.parametrize("cells", [9, 225])
def test_a_price_in_states_that_are_not_reached_leaves_no_rounding_elsewhere(cells: int) -> None:
    rng, known = np.random.default_rng(0), np.arange(cells) % 2 == 0
    stays, transition = np.eye(cells)[known], random_kernel(rng, cells, 0.05)
    transition[np.ix_(known, ~known)] = 0.0
    transition[known] = 0.9 * stays + 0.09 * transition[known]
    priced = np.stack([np.where(known, 1.0, -price) for price in (1.0, 1e14)], axis=1)
    cheap, dear = accumulate(sparse.csr_array(transition), priced)[known].T
    np.testing.assert_allclose(dear, cheap, rtol=1e-13)


@pytest.mark.parametrize("transposed", [False, True])
@settings(max_examples=10)
@given(st.integers(0, 2**31), st.integers(1, 6))
def test_events_that_lead_to_higher_levels_alone_are_solved_in_order(
    transposed: bool, seed: int, count: int
) -> None:
    """Some levels with no event among them."""
    rng = np.random.default_rng(seed)
    level = rng.integers(count, size=12)
    later = (level[:, None] < level) * (rng.random((12, 12)) < 0.5)
    moves, gathered = later * rng.random((12, 12)), rng.standard_normal((12, 2))
    system = moves.T if transposed else moves
    found = solve_onward(level, sparse.csr_array(moves), gathered, transposed=transposed)
    np.testing.assert_allclose(found, np.linalg.solve(np.eye(12) - system, gathered), rtol=1e-9)


def test_long_episodes_take_few_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk on 64 x 64 cells that exits with 1e-5 a step: without blocks it takes thousands of products."""
    kernel = random_walk(64, stay=0.2, diagonal=False, exit_probability=1e-5, border="clip")
    system = RenewalSystem(sparse.csr_array(kernel), (64, 64), direct=0)
    monkeypatch.setattr(linear, "_MOST_PRODUCTS", 400)
    steps = system.solve(np.ones(4096))
    np.testing.assert_allclose(steps, 1e5, rtol=1e-9)


def test_a_guess_that_is_the_solution_is_kept() -> None:
    kernel = sparse.csr_array(random_kernel(np.random.default_rng(0), 36, 0.1))
    system = RenewalSystem(kernel, (6, 6), direct=0)
    found = system.solve(np.ones(36))
    assert np.array_equal(system.solve(np.ones(36), found), found)


@pytest.mark.parametrize("cells", [4, 256])  # as a full matrix and as a sparse one
def test_without_an_exit_there_is_no_solution(cells: int) -> None:
    never = sparse.csr_array(np.roll(np.eye(cells), 1, axis=1))
    with pytest.raises(UserError, match="never exits"):
        accumulate(never, np.ones(cells))


def _small(t_max: int = 1) -> World:
    kernel = random_walk(6, stay=0.2, diagonal=True, exit_probability=0.01, border="clip")
    return World(kernel, 6, cost=0.2, t_max=t_max)


def test_all_figures_and_bounds_of_a_large_world_are_those_of_the_factorisation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As if 36 cells were too many to factorise: same policy, same figures, errors stated and kept."""
    world, again = _small(), _small()
    exact, solution = evaluate(world, rules.clocked_policy(world)), solve(world)
    table = clocked_table(world)
    assert exact.error == table.error == 0.0
    defaults = RenewalSystem.__init__.__kwdefaults__ | {"direct": 0}
    monkeypatch.setattr(RenewalSystem.__init__, "__kwdefaults__", defaults)
    for module in (value, renewal):
        monkeypatch.setattr(module, "DIRECT_CELLS", 0)
    monkeypatch.setattr(renewal, "_DIRECT", 0)
    monkeypatch.setattr(linear, "FULL", 0)
    iterated = evaluate(again, rules.clocked_policy(again))
    assert 0.0 < iterated.error < 1e-9
    assert np.abs(iterated.value - exact.value).max() <= iterated.error
    for figure in ("accuracy", "sensors_per_step", "safe_per_episode", "expected_length"):
        assert getattr(iterated, figure) == pytest.approx(getattr(exact, figure), rel=1e-10)
    np.testing.assert_allclose(iterated.steps, exact.steps, rtol=1e-9, atol=1e-12)
    assert iterated.sensors is None
    loose = clocked_table(again)
    assert (loose.value >= table.value - 1e-12).all()
    np.testing.assert_allclose(loose.table, table.table, atol=1e-9)
    found = solve(again)
    assert found.certified == solution.certified
    assert found.lower == pytest.approx(solution.lower, abs=1e-9)
    assert found.upper == pytest.approx(solution.upper, abs=1e-6 * abs(solution.upper))


def test_expected_steps_of_a_world_are_its_mean_time_to_the_exit() -> None:
    np.testing.assert_allclose(expected_steps(_small()), 100.0)


@pytest.mark.parametrize("layers", [1, 2])
def test_a_level_below_a_level_gives_the_same_solution(
    monkeypatch: pytest.MonkeyPatch, layers: int
) -> None:
    monkeypatch.setattr(
        multigrid, "COARSEST", 4 * layers
    )  # 30 x 21 cells, 8 x 6 blocks, 2 x 2 blocks of those
    world = tm.make_world("random_support", size=[30, 21], support_size=5)
    # with two states a cell, half of all that moves changes its state
    kernel = (
        world.kernel
        if layers == 1
        else sparse.kron(np.full((2, 2), 0.5), world.kernel, format="csr")
    )
    sizes, made = list[int](), multigrid.Level.__init__

    def counted(self: Any, system: sparse.csr_array, size: Any) -> None:
        sizes.append(system.shape[0])
        made(self, system, size)

    monkeypatch.setattr(multigrid.Level, "__init__", counted)
    system = RenewalSystem(sparse.csr_array(kernel), (30, 21), direct=0)
    gathered = np.random.default_rng(0).random(630 * layers)
    expected = np.linalg.solve(np.eye(630 * layers) - kernel.toarray(), gathered)
    np.testing.assert_allclose(system.solve(gathered), expected, rtol=1e-10)
    assert sizes == [630 * layers, 48 * layers]


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.integers(2, 12), st.integers(0, 700))
def test_visits_of_a_part_of_the_changes_are_those_of_the_mixed_system(
    seed: int, states: int, direct: int
) -> None:
    """The gain of any of the states that change, solved for among these alone."""
    rng = np.random.default_rng(seed)
    before, after = (random_kernel(rng, states, 0.1) for _ in range(2))
    moved = np.flatnonzero(rng.random(states) < 0.7)
    after[np.setdiff1d(np.arange(states), moved)] = before[np.setdiff1d(np.arange(states), moved)]
    old, new = (
        RenewalSystem(sparse.csr_array(each), (1, states), direct=direct)
        for each in (before, after)
    )
    change = np.eye(len(moved)) - old.changed(new, moved)
    start, earned, more = rng.random(states), rng.random(states), rng.random(states)
    value, visits = old.solve(earned), old.solve(start, transposed=True)
    some = np.flatnonzero(rng.random(len(moved)) < 0.5)
    here = moved[some]
    mixed, paid = before.copy(), earned.copy()
    mixed[here], paid[here] = after[here], more[here]
    gain = (more + after @ value - value)[here]
    expected = start @ np.linalg.solve(np.eye(states) - mixed, paid) - start @ value
    found = visits[here] @ np.linalg.solve(change[np.ix_(some, some)], gain)
    assert found == pytest.approx(expected, rel=1e-7, abs=1e-7)
