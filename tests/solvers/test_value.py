"""Exact values by hand, with limits of steps, misses and hidden modes; `test_pairs` has all of them together."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.helpers import headings, hop_world, limited, small_world
from tests.solvers.test_pairs import random_policy
from tests.solvers.worlds import REFERENCES, reference_world
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, linear, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.solvers.motion_totals import expected_steps
from trackmdp.solvers.value import key_visits
from trackmdp.world.model import World


@pytest.mark.parametrize("reference", REFERENCES, ids=lambda row: row["name"])
def test_counts_agree_with_the_reference(reference: dict) -> None:
    world = reference_world(reference)
    result = evaluate(world, rules.qmdp(world))
    assert result.accuracy == pytest.approx(reference["qmdp_accuracy"], abs=1e-9)
    np.testing.assert_allclose(result.safe_actions, reference["qmdp_safe_actions"], atol=1e-9)
    expected = np.mean(reference["qmdp_safe_actions"])
    assert result.safe_per_episode == pytest.approx(expected, abs=1e-9)


def test_a_world_by_hand() -> None:
    """Two cells matter: the target hops 0 -> 1 -> 0 and exits with probability 1/2 each step; sense nothing, t_max = 0.

    From either cell: a miss in the grid (1/2), then the forced step (1/4, located). Renewals: 1 / (1 - 1/4).
    """
    kernel = np.zeros((4, 4))
    kernel[0, 1] = kernel[1, 0] = 0.5
    world = World(
        kernel, 2, cost=np.array([0.1, 0.2, 0.3, 0.4]), safe_cost=1.0, t_max=0, reward=3.0
    )
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
    np.testing.assert_allclose(
        always.value[:2], np.linalg.solve([[1, -0.5], [-0.5, 1]], [0.5 * 2.8, 0.5 * 2.9])
    )
    assert always.accuracy == 1.0
    assert always.sensors_per_step == pytest.approx(1.0)


def two_cells(**sensors: Any) -> World:
    """The target changes places or leaves, with probabilities .8 and .2."""
    kernel = np.array([[0.0, 0.8], [0.8, 0.0]])
    return World(kernel, (1, 2), cost=0.1, t_max=0, safe_cost=0.3, **sensors)


def other_cell(world: World) -> PolicyTable:
    return PolicyTable.from_dense(world, np.array([[[False, True]], [[True, False]]]))


def test_sensors_that_miss_by_hand() -> None:
    """V = .8 (.5 (1 + V) - .1) + .4 · .8 (1 - .3 + V) = .544 + .72 V: half of all looks miss; the safe one follows."""
    world = two_cells(detection=0.5)
    assert evaluate(world, other_cell(world)).value == pytest.approx([0.544 / 0.28] * 2)
    # The cell of the target is known at all times: the bound that reveals it is the optimum.
    assert bounds.clocked(world) == pytest.approx([0.544 / 0.28] * 2)
    assert bounds.clocked(replace(world, max_steps=1)) == pytest.approx([0.8 * 0.4] * 2)


def test_a_safe_action_that_misses_is_repeated() -> None:
    """L = .8 (.5 (1 + V) + .5 L - .3) gives L = (.16 + .4 V) / .6; V = .8 (.5 (1 + V) - .1) + .4 L."""
    world = two_cells(detection=0.5, safe_detection=0.5)
    found = evaluate(world, other_cell(world))
    by_hand = (0.32 + 0.4 * 0.16 / 0.6) / (1 - 0.4 - 0.16 / 0.6)
    assert found.value == pytest.approx([by_hand] * 2)
    assert found.expected_length == pytest.approx(5.0)  # one step in five is the exit
    # In two steps: .8 (.5 - .1), then .4 · .8 (.5 - .1) where located, or the safe action .4 · .8 (.5 - .3).
    two = evaluate(replace(world, max_steps=2), other_cell(world))
    assert two.value == pytest.approx([0.32 + 0.4 * 0.32 + 0.4 * 0.16] * 2)


def to_and_fro(**more: Any) -> World:
    """Two cells and two modes: to and fro (the cell changes with .9), or lazy (it stays); the mode changes with .2."""
    move = {0: np.array([[0.1, 0.9], [0.9, 0.1]]), 1: np.array([[0.9, 0.1], [0.1, 0.9]])}
    kernel = np.zeros((4, 4))
    for x, u, y, v in itertools.product(range(2), repeat=4):
        kernel[2 * x + u, 2 * y + v] = 0.9 * move[v][x, y] * (0.8 if u == v else 0.2)
    return World(kernel, (1, 2), modes=2, cost=0.45, t_max=0, safe_cost=0.7, **more)


def test_revealed_modes_by_hand() -> None:
    """t_max = 0, and .9 to be in the grid after a step."""
    world = to_and_fro(reveals=True)
    # All on, 2 sensors: V = .9 (1 - .9 + V) = .09 / .1.
    assert evaluate(world, PolicyTable.all_on(world)).value == pytest.approx([0.9, 0.9])
    # After mode 0 the other cell alone, after mode 1 its own: right with .8 · .9 + .2 · .1 = .74. By symmetry one V:
    # .9 (.74 - .45 + .74 V) + .9 · .26 · .9 (1 - .7 + V) whatever the mode.
    table = np.zeros((4, 1, 2), dtype=bool)
    table[[0, 1, 2, 3], 0, [1, 0, 0, 1]] = True
    hit, missed = 0.9 * 0.74, 0.9 * 0.26 * 0.9
    by_hand = (hit - 0.9 * 0.45 + missed * (1 - 0.7)) / (1 - hit - missed)
    found = evaluate(world, PolicyTable.from_dense(world, table)).value
    assert found == pytest.approx([by_hand, by_hand])


def test_episodes_cut_after_some_steps() -> None:
    world = hop_world()
    sets = np.zeros((4, 2, 4), dtype=bool)
    sets[0, 0, 1] = True  # from cell 0 the next cell is sensed, from the others nothing is
    figures = evaluate(limited(world, 1), sets)
    np.testing.assert_allclose(figures.value, [0.75 * (2.0 - 0.2), 0.0, 0.0, 0.0])
    assert figures.expected_length == 1.0
    assert figures.accuracy == pytest.approx(0.25)
    never = small_world(exit_probability=0.0, max_steps=50)
    figures = evaluate(never, np.ones((9, 2, 9), dtype=bool))
    assert figures.aihtr == pytest.approx(50 * (1.0 - 9 * 0.2))
    assert figures.expected_length == pytest.approx(50.0)


def test_a_limit_that_no_episode_reaches_changes_nothing_and_takes_no_longer() -> None:
    """10^18 rounds of the recursion would have no end; it stops where its values do not change any more."""
    world = small_world(exit_probability=0.1)
    everything, cut = np.ones((9, 2, 9), dtype=bool), limited(world, 10**18)
    assert evaluate(cut, everything).aihtr == pytest.approx(evaluate(world, everything).aihtr)
    for bound in (bounds.clocked, bounds.valid):
        np.testing.assert_allclose(bound(cut), bound(world))


@pytest.mark.parametrize("memory", ["cell", "displacement"])
def test_keys_are_visited_at_the_start_and_at_each_detection(memory: str) -> None:
    world = headings(3, t_max=1, memory=memory)
    policy = random_policy(world, 5)
    found, visits = evaluate(world, policy), key_visits(world, policy)
    assert found.detections is not None
    assert visits.sum() == pytest.approx(1.0 + found.detections.mean())
    if memory == "displacement":  # only the start has no displacement before it
        assert visits[:: world.keys.num_classes] == pytest.approx(1 / 9)


def test_large_systems_of_keys_are_iterated_to_the_same_value(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = headings(3, memory="displacement")
    policy = random_policy(world, 1)
    exact, visits = evaluate(world, policy), key_visits(world, policy)
    monkeypatch.setattr(linear, "KEYED_DIRECT", 0)
    iterated = evaluate(world, policy)
    assert exact.error == 0 < iterated.error < 1e-9
    assert np.abs(iterated.value - exact.value).max() <= iterated.error
    assert iterated.accuracy == pytest.approx(exact.accuracy, rel=1e-11)
    assert key_visits(world, policy) == pytest.approx(visits, abs=1e-9)


def test_systems_of_keys_with_modes_take_few_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events of one state are a group: with groups of a cell the error is 300 times as large."""
    world = headings(6, memory="displacement")
    monkeypatch.setattr(linear, "_MOST_PRODUCTS", 10)
    assert evaluate(world, random_policy(world, 1)).error < 1e-6


def test_a_kernel_that_never_exits_has_no_value() -> None:
    world = World(np.full((4, 4), 0.25), 2, cost=0.1, t_max=1, max_steps=9)
    with pytest.raises(UserError, match="never exits"):
        expected_steps(world)


def test_policies_for_other_worlds_are_refused() -> None:
    world = World(np.full((4, 4), 0.2), 2, cost=np.full(4, 0.1), safe_cost=0.4, t_max=1)
    with pytest.raises(UserError, match=r"expected shape \(4, 2, 4\)"):
        evaluate(world, np.zeros((4, 1, 4), dtype=bool))
    with pytest.raises(UserError, match="between 0 and 1"):
        evaluate(world, np.full((4, 2, 4), 1.5))
    with pytest.raises(UserError, match="8 modes; expected 1"):
        evaluate(world, PolicyTable.none(headings(2, revealed=8)))
    covered = World.of(world, world.kernel, coverage=np.ones((2, 4)), cost=0.1)
    with pytest.raises(UserError, match="other footprints"):
        evaluate(covered, PolicyTable.all_on(world))
