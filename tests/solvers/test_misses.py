"""Sensors that miss: exact values, bounds and the certified optimum against brute force written apart from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.solvers.worlds import best_of_all, tiny_worlds, value_of
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, lookahead, optimal, qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.recorded import replay
from trackmdp.solvers.search import located_value
from trackmdp.world.model import Array, BoolArray, Task, World
from trackmdp.world.tracks import Tracks


def _two_cells(**sensors: object) -> World:
    """The target changes places or leaves, with probabilities .8 and .2; only its place after the move is sensed."""
    kernel = np.array([[0.0, 0.8], [0.8, 0.0]])
    return World(kernel, (1, 2), cost=0.1, t_max=0, safe_cost=0.3, **sensors)  # type: ignore[arg-type]


def _other_cell(world: World) -> PolicyTable:
    return PolicyTable.from_dense(world, np.array([[[False, True]], [[True, False]]]))


def test_two_cells_by_hand() -> None:
    """V = .8 (.5 (1 + V) - .1) + .4 · .8 (1 - .3 + V) = .544 + .72 V: half of all looks miss; the safe one follows."""
    world = _two_cells(detection=0.5)
    assert evaluate(world, _other_cell(world)).value == pytest.approx([0.544 / 0.28] * 2)
    # Where the target is, is known at all times: the bound that reveals it is the optimum.
    assert bounds.clocked(world) == pytest.approx([0.544 / 0.28] * 2)
    assert bounds.clocked(replace(world, max_steps=1)) == pytest.approx([0.8 * 0.4] * 2)


def test_a_safe_action_that_misses_is_repeated() -> None:
    """L = .8 (.5 (1 + V) + .5 L - .3) gives L = (.16 + .4 V) / .6; V = .8 (.5 (1 + V) - .1) + .4 L."""
    world = _two_cells(detection=0.5, safe_detection=0.5)
    found = evaluate(world, _other_cell(world))
    value = (0.32 + 0.4 * 0.16 / 0.6) / (1 - 0.4 - 0.16 / 0.6)
    assert found.value == pytest.approx([value] * 2)
    assert found.expected_length == pytest.approx(5.0)  # whatever is sensed: one step in five is the exit


@given(tiny_worlds(misses=True), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_values_are_those_of_stepping_through_the_chains(world: World, seed: int) -> None:
    chains = np.random.default_rng(seed).random((world.num_cells, world.num_choices, world.num_cells)) < 0.5
    assert evaluate(world, chains).value == pytest.approx(value_of(world, chains), abs=1e-9)


@given(tiny_worlds(misses=True))
@settings(max_examples=12, deadline=None)
def test_the_certified_optimum_is_that_of_all_chains(world: World) -> None:
    best, found = best_of_all(world), optimal.solve(world, tolerance=1e-9)
    assert found.certified
    assert found.value == pytest.approx(best, abs=1e-7)
    assert (bounds.clocked(world) >= best - 1e-9).all()
    assert (bounds.valid(world) >= bounds.clocked(world) - 1e-9).all()
    for planned in (lookahead.solve(world), qmdp.solve(world), qmdp.fcr(world)):
        assert (evaluate(world, planned).value <= best + 1e-9).all()


@given(tiny_worlds(size=1, misses=True, most_t_max=3), st.integers(1, 9))
@settings(max_examples=15, deadline=None)
def test_values_and_bounds_of_few_steps(world: World, max_steps: int) -> None:
    world = replace(world, max_steps=max_steps)
    chains = np.ones((1, world.num_choices, 1), dtype=bool)
    assert evaluate(world, chains).value == pytest.approx(_in_steps(world, chains, max_steps))
    for bound in (bounds.clocked, bounds.valid):
        assert (bound(world) >= evaluate(world, chains).value - 1e-12).all()


def _in_steps(world: World, chains: BoolArray, steps: int) -> Array:
    """One cell: the mass after n misses, step by step."""
    stay, earned = world.kernel.toarray()[0, 0], 0.0
    mass = np.zeros(world.num_choices + 1)
    mass[0] = 1.0
    for _ in range(steps):
        mass = mass * stay
        found = np.append(world.detection[0] * chains[0, :, 0], world.safe_detection[0]) * mass
        paid = np.append(world.cost[0] * chains[0, :, 0], world.safe_cost) * mass
        earned += world.reward * found.sum() - paid.sum()
        missed = mass - found
        mass = np.append(found.sum(), missed[:-1])
        mass[-1] += missed[-1]  # the clock stays at t_max + 1
    return np.array([earned])


def test_the_value_during_a_search_is_the_exact_one() -> None:
    from trackmdp.solvers.layers import layer_sets, reachable_layers

    rng = np.random.default_rng(3)
    kernel = rng.dirichlet(np.ones(9), size=9) * 0.95
    for safe_detection in (1.0, 0.6):
        world = World(kernel, 3, cost=0.1, t_max=2, detection=0.8, safe_detection=safe_detection)
        layers, table = reachable_layers(world, 3), PolicyTable.from_dense(world, rng.random((9, 3, 9)) < 0.5)
        value = located_value(world, layers, layer_sets(layers, table))
        assert value == pytest.approx(evaluate(world, table).value)


def test_recorded_tracks_take_hits_as_probabilities() -> None:
    """Cells 0 1 0, then out; p_d = .5 and p_s = .5: seen at 1, or at 0 by the safe action, or not at all."""
    task = Task((1, 2), cost=0.1, t_max=0, safe_cost=0.3, detection=0.5, safe_detection=0.5)
    tracks = Tracks(np.array([0, 1, 0]), np.array([0, 3]), np.array([True]), np.array([0]))
    found = replay(task, tracks, PolicyTable.all_on(task))
    # First step .5 - .2; then, seen: .5 - .2, missed: the safe action, .5 - .3.
    assert found.totals[0] == pytest.approx([0.3 + 0.5 * 0.3 + 0.5 * 0.2, 2.0, 1.0, 2.0 + 0.5 * 2.0, 0.5])


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"detection": 1.2}, "detection: cell 0 has 1.2, expected a probability above 0, at most 1"),
        ({"detection": [0.5, 0.0]}, "detection: cell 1 has 0.0, expected a probability above 0"),
        ({"safe_detection": np.nan}, "safe_detection: cell 0 has nan"),
        ({"detection": [0.5]}, r"detection: 1 values, expected one number or 2 \(one per cell\)"),
    ],
)
def test_no_probability_is_refused(given: dict[str, object], told: str) -> None:
    with pytest.raises(UserError, match=told):
        _two_cells(**given)
