"""Interquartile means, intervals and profiles, against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trackmdp.reports.statistics import estimate, iqm, profile

VALUES = st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=6)


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    assert iqm(np.array([100.0, 1.0, 2.0, 3.0, -50.0])) == 2.0
    assert iqm(np.array([0.0, 1.0, 2.0, 9.0])) == 1.5
    assert iqm(np.array([1.0, 5.0, 9.0])) == 5.0  # a quarter of three, rounded down, is none


def test_an_estimate_is_over_all_groups_together() -> None:
    found = estimate([[1.0, 2.0], [3.0], [100.0]], "a", resamples=200)
    assert (found.mean, found.n) == (2.5, 4)


def test_single_runs_have_no_interval() -> None:
    assert estimate([[1.0], [2.0]], "a", resamples=200).low is None
    nothing = estimate([[], []], "a", resamples=200)
    assert nothing.n == 0
    assert math.isnan(nothing.mean)


@given(st.lists(VALUES, min_size=1, max_size=3))
def test_an_interval_lies_within_the_data(groups: list[list[float]]) -> None:
    found = estimate(groups, "a", resamples=100)
    everything = [value for group in groups for value in group]
    assert found.low is not None
    assert found.high is not None
    assert min(everything) - 1e-9 <= found.low <= found.high <= max(everything) + 1e-9


def test_an_interval_is_that_of_the_bootstrap_within_each_group() -> None:
    # each group alone is constant, so resampling within groups changes nothing; across groups it would
    found = estimate([[0.0, 0.0], [10.0, 10.0]], "a", resamples=200)
    assert (found.low, found.high) == (found.mean, found.mean) == (5.0, 5.0)
    wide = estimate([[0.0, 10.0]], "a", resamples=2000)
    assert (wide.low, wide.high) == (0.0, 10.0)  # both draws alike in a quarter of the resamples each


def test_the_same_name_gives_the_same_interval() -> None:
    group = [list(np.random.default_rng(0).normal(size=5))]
    one, again, other = (estimate(group, name, resamples=100) for name in ("a", "a", "b"))
    assert one == again
    assert (one.low, one.high) != (other.low, other.high)


def test_a_profile_is_the_share_of_runs_at_most_at_each_level() -> None:
    share, interval = profile([[0.1, 0.3], [0.2, 0.4]], np.array([0.0, 0.1, 0.25, 1.0]), "a", resamples=200)
    assert share.tolist() == [0.0, 0.25, 0.5, 1.0]
    assert interval.shape == (2, 4)
    assert (interval[0] <= share).all()
    assert (share <= interval[1]).all()
    assert interval[:, [0, 3]].tolist() == [[0.0, 1.0], [0.0, 1.0]]


def test_a_profile_of_single_runs_has_no_band() -> None:
    share, interval = profile([[0.1], [0.2]], np.array([0.15]), "a", resamples=200)
    assert share.tolist() == [0.5]
    assert interval.tolist() == [[0.5], [0.5]]


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_a_group_of_one_stays_as_it_is_in_every_resample(level: float) -> None:
    share, interval = profile([[0.1], [0.2, 0.9]], np.array([level]), "a", resamples=300)
    if level:
        assert interval[0, 0] == pytest.approx(1 / 3)  # the single run is always below
        assert interval[1, 0] == 1.0
    else:
        assert (share[0], interval[1, 0]) == (0.0, 0.0)
