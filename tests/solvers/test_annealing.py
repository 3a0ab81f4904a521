"""Policies from chances: derivatives, and what annealing ends with."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.helpers import headings
from trackmdp.sensing.decisions import sensing
from trackmdp.solvers import annealing
from trackmdp.solvers.annealing import anneal
from trackmdp.solvers.exchange import exchanged
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found, clocked_sets, follow_credit
from trackmdp.world.make import make_world
from trackmdp.world.model import World

PAIRS = np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 1, 1]], dtype=bool)
KINDS: dict[str, dict[str, Any]] = {
    "own": {},
    "misses": {"detection": np.array([0.7, 0.8, 0.9, 1.0]), "safe_detection": 0.6},
    "shared": {"coverage": PAIRS, "cost": 0.2, "safe_cost": None},
    "shared, misses": {"coverage": PAIRS, "cost": 0.2, "safe_cost": None, "detection": 0.8},
}


def world_of(kind: str) -> World:
    return headings(2, 0.8, cost=0.2, t_max=2, memory="displacement").but(**KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_a_slope_is_the_derivative_of_what_is_reported(kind: str) -> None:
    """Two entries of one cell, another cell, and a second row; each chance up and down a little."""
    rng = np.random.default_rng(3)
    choice = sensing(world_of(kind), np.array([0, 0, 0, 1, 1]), np.array([1, 1, 2, 0, 3]), 2)
    on, gain = rng.random((len(choice.rows), 1)), rng.standard_normal((5, 1))
    found = choice.slope(gain, on)
    for place in range(len(on)):
        step = np.zeros_like(on)
        step[place] = 1e-6
        rise = choice.report(on + step) - choice.report(on - step)
        assert found[place, 0] == pytest.approx(float((gain * rise).sum()) / 2e-6, abs=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_certain_chances_are_sets(kind: str) -> None:
    world = world_of(kind)
    renewal, rng = Renewal(world, world.motion), np.random.default_rng(1)
    sets = [rng.random((len(choice.rows), 1)) < 0.5 for choice in renewal.choices]
    chances = [on.astype(np.float64) for on in sets]
    assert Found(renewal, chances).aihtr == pytest.approx(Found(renewal, sets).aihtr, abs=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_an_advantage_is_what_a_chance_gains_a_visit(kind: str) -> None:
    """The AIHTR's derivative is the advantage times the visits with which the sensor is decided about."""
    world = world_of(kind)
    renewal, rng = Renewal(world, world.motion), np.random.default_rng(2)
    chances = [rng.uniform(0.1, 0.9, (len(choice.rows), 1)) for choice in renewal.choices]
    policy = Found(renewal, chances)
    assert policy.visits is not None
    plans = renewal.problem(policy.value, policy.visits)
    advantages, now = plans.advantages(chances, 0.0), plans.mass
    for t, (turn, chance) in enumerate(zip(plans.turns, chances, strict=True), start=1):
        now = turn.back @ now
        come = (turn.sums @ now)[turn.choice.rows, 0]
        place = int(np.argmax(come))
        rise = 0.0
        for sign in (1.0, -1.0):
            other = [each.copy() for each in chances]
            other[t - 1][place] += sign * 1e-5
            rise += sign * Found(renewal, other).aihtr / 2e-5
        assert rise == pytest.approx(advantages[t - 1][place, 0] * come[place], rel=1e-4, abs=1e-6)
        now = plans.missing(t, chance, now)


def test_optimism_weighs_the_credit_against_the_exact_gain() -> None:
    """A credit of .5 everywhere: full optimism leaves .5 p_d less the price, half of it the mean of both."""
    world = world_of("own").but(detection=0.8)
    renewal = Renewal(world, world.motion)
    chances = [np.full((len(choice.rows), 1), 0.5) for choice in renewal.choices]
    nothing = np.zeros(renewal.count)
    credit = [np.full(world.num_states, 0.5) for _ in renewal.choices]
    plans = renewal.problem(nothing, renewal.shares(nothing), credit)
    exact, half, full = (plans.advantages(chances, share) for share in (0.0, 0.5, 1.0))
    for one, mean, other, turn in zip(exact, half, full, plans.turns, strict=True):
        np.testing.assert_allclose(mean, (one + other) / 2)
        # The gain falls to those of its row in the sensor's cell: all of them together make 1.
        share = (other[:, 0] + turn.price) / (0.5 * 0.8)
        total = np.bincount(turn.choice.rows, share)
        np.testing.assert_allclose(total[np.unique(turn.choice.rows)], 1.0)


def test_sensors_out_of_the_window_have_no_chance() -> None:
    world = headings(3, 0.8, cost=0.05, t_max=1, memory="displacement").but(window=1)
    renewal = Renewal(world, world.motion)
    odds = [np.full((len(choice.rows), 1), 2.0) for choice in renewal.choices]
    for choice, chance in zip(renewal.choices, annealing._chances(renewal, odds), strict=True):
        assert choice.allowed is not None
        np.testing.assert_allclose(chance, np.where(choice.allowed, 1 / (1 + np.exp(-2)), 0))
    assert 0 < (chance == 0).sum() < len(chance)  # two moves may lead out of it


@pytest.mark.slow
def test_annealed_policies_end_above_the_homotopy() -> None:
    """Where the safe action misses, its states depend on all plans; each seed ends above, and not where others do."""
    made = make_world("heading", size=3, cost=0.296, t_max=1, memory="displacement_gap")
    world = made.but(safe_detection=0.86)
    renewal = Renewal(world, world.motion)
    first = Found(renewal, clocked_sets(renewal))
    led = exchanged(follow_credit(first, 12, 1))
    found = [exchanged(anneal(renewal, np.random.default_rng(seed))).aihtr for seed in (0, 0, 1)]
    assert found[0] == found[1] != found[2]
    assert min(found) > led.aihtr * 1.005


def test_the_lead_of_the_credit_ends_above_where_nothing_misses() -> None:
    world = make_world("heading", size=3, memory="displacement")
    renewal, rng = Renewal(world, world.motion), np.random.default_rng(0)
    plain, led = (
        max(exchanged(anneal(renewal, rng, led=led)).aihtr for _ in range(3))
        for led in (False, True)
    )
    assert led > plain


@pytest.mark.parametrize("changes", [{"window": 1}, {"budget": 1}])
def test_limits_hold_for_annealed_policies(changes: dict[str, int]) -> None:
    world = headings(3, 0.8, cost=0.05, t_max=1, memory="displacement").but(**changes)
    renewal = Renewal(world, world.motion)
    policy = anneal(renewal, np.random.default_rng(0))
    for choice, on in zip(renewal.choices, policy.sets, strict=True):
        assert on.any()
        if "budget" in changes:
            assert np.bincount(choice.rows[on[:, 0]]).max() == 1
        else:
            assert choice.allowed is not None
            assert not (on & ~choice.allowed).any()


def test_temperatures_and_errors_are_in_rewards() -> None:
    """Ten times the rewards and the prices: the same policy, ten times its worth."""
    world = headings(3, 0.8, cost=0.2, t_max=1, memory="displacement").but(safe_detection=0.8)
    tenfold = world.but(cost=10 * world.cost, safe_cost=10 * world.safe_cost, reward=10.0)
    one, other = (
        anneal(Renewal(each, each.motion), np.random.default_rng(4), led=True)
        for each in (world, tenfold)
    )
    assert other.aihtr == pytest.approx(10 * one.aihtr)


@pytest.mark.parametrize(
    ("reward", "price", "safe_cost"), [(0.0, 0.05, 3.0), (0.0, 0.0, 0.0), (5e-324, 0.05, 3.0)]
)
def test_without_rewards_temperatures_are_in_safe_actions(
    reward: float, price: float, safe_cost: float
) -> None:
    world = headings(3, 0.8, cost=price, t_max=1).but(safe_cost=safe_cost, reward=reward)
    renewal = Renewal(world, world.motion)
    none = [np.zeros((len(choice.rows), 1), dtype=bool) for choice in renewal.choices]
    found = exchanged(anneal(renewal, np.random.default_rng(0), led=True))
    # To sense spares safe actions.
    assert found.aihtr - Found(renewal, none).aihtr >= 5 * safe_cost
