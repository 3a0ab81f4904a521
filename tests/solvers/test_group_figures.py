"""Intervals of the figures of several targets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trackmdp.arrays.types import Array
from trackmdp.solvers.several import group_value
from trackmdp.solvers.several.group_figures import GroupEvaluation


@pytest.mark.parametrize("count", [3, 4, 6, 12])
def test_intervals_of_few_episodes_cover_what_they_say(count: int) -> None:
    rng = np.random.default_rng(1)
    steps, known, rest = rng.normal([[[5.0]], [[1.0]], [[2.0]]], 1.0, (3, 400, count))
    covered = 0
    for each in zip(steps + known / 2 + rest, steps, known, strict=True):
        totals = np.zeros((count, 7))
        totals[:, [0, 1, 6]] = np.transpose(each)
        found = GroupEvaluation(totals, False, 5.0, (5.0, 1.0)).aihtr
        assert found.low is not None
        assert found.high is not None
        covered += found.low <= 7.5 <= found.high
    assert 0.91 < covered / 400 < 0.98


def test_intervals_that_are_soon_as_narrow_as_wanted_cover_what_they_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Rewards with a tail, 2 on average with a spread of 1; a width that some 64 episodes have, by luck fewer."""
    rng = np.random.default_rng(3)

    def drawn(rule: Any, episodes: int, *_: Any) -> Array:
        totals = rng.normal(size=(episodes, 7))
        totals[:, 0] = 1.0 + rng.exponential(size=episodes)
        return totals

    monkeypatch.setattr(group_value, "simulated", drawn)
    covered = 0
    for seed in range(2000):
        found = group_value._played(Any, (1.0, (0.0, 0.0)), 1.96 / 8, seed, None).aihtr
        assert found.low is not None
        assert found.high is not None
        covered += found.low <= 2.0 <= found.high
    assert 0.935 < covered / 2000 < 0.965


@pytest.mark.parametrize(("on", "episodes"), [(3.0, 2**17), (2.0**17, 1024), (2.0**20, 256)])
def test_episodes_are_fewer_where_many_sensors_are_on(
    monkeypatch: pytest.MonkeyPatch, on: float, episodes: int
) -> None:
    """No number of them has the width that is wanted; 2**27 sensors are on at most, but in the first 256."""
    rng = np.random.default_rng(3)

    def drawn(rule: Any, count: int, *_: Any) -> Array:
        totals = rng.normal(size=(count, 7))
        totals[:, 3] = on
        return totals

    monkeypatch.setattr(group_value, "simulated", drawn)
    found = group_value._played(Any, (1.0, (0.0, 0.0)), 1e-9, 0, None)
    assert len(found.totals) == episodes


def test_two_episodes_have_no_interval() -> None:
    found = GroupEvaluation(np.arange(14.0).reshape(2, 7), False, 5.0, (5.0, 1.0))
    assert found.aihtr.low is None
    assert found.reward_per_step.low is None


def test_a_difference_is_corrected_by_the_steps_of_the_targets() -> None:
    rng = np.random.default_rng(0)
    mine, theirs = np.zeros((2, 200, 7))
    mine[:, 1] = theirs[:, 1] = rng.normal(5.0, 1.0, 200)
    mine[:, 0] = 2 * mine[:, 1] + rng.normal(0.0, 0.01, 200)
    one, other = (GroupEvaluation(each, False, 5.0, (5.0, 0.0)) for each in (mine, theirs))
    found = one.less(other).aihtr
    assert found.low is not None
    assert found.high is not None
    assert found.low < 10.0 < found.high < found.low + 0.02


def test_a_single_episode_that_differs_says_one_thing() -> None:
    """Steps and known rewards then differ together: only one of the two can explain the reward."""
    for other in np.linspace(1.0, 19.0, 200):
        totals = np.zeros((64, 7))
        totals[:, 0] = np.arange(64) / 64
        totals[:, [1, 6]] = 20.0, 20.263729627154635
        totals[0, [1, 6]] = other, 1.0131864830135174 * (other + 1.0)
        means = totals[:, [1, 6]].mean(axis=0)
        found = GroupEvaluation(totals, False, 20.0, tuple(means + 1e-3)).aihtr
        assert found.low is not None
        assert found.high is not None
        assert found.mean == pytest.approx(totals[:, 0].mean(), abs=0.02)
        assert 0.05 < found.high - found.mean < 0.1


def test_what_no_episode_has_shown_may_happen_all_the_same() -> None:
    """As of single targets: 40 episodes without a miss and without a safe action do not rule them out."""
    totals = np.tile([4.0, 5.0, 5.0, 9.0, 0.0, 6.0, 4.0], (40, 1))
    found = GroupEvaluation(totals, False, 6.0, None)
    assert (found.accuracy.mean, found.safe_per_step.mean) == (1.0, 0.0)
    assert found.safe_per_step.low == 0.0
    assert found.safe_per_step.high == pytest.approx((1 - 0.025 ** (1 / 40)) / 6)
    assert found.accuracy.low == pytest.approx(1 - (1 - 0.025 ** (1 / 40)) / 5)
    assert found.accuracy.high == 1.0
