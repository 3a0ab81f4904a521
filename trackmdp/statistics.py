"""Intervals that cover at small n: Student's t within each group, Clopper and Pearson's for shares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

__all__ = ["FEWEST", "LEVEL", "Estimate", "iqm", "mean_over_groups", "share"]

LEVEL = 0.95
"""Nominal coverage of every interval."""
FEWEST = 3
"""Values a group needs before an interval is shown: from two, its width says more of luck than of the spread."""


@dataclass(frozen=True)
class Estimate:
    """A mean of `n` values with its 95 % interval; `low` and `high` are None where too few values stand behind it."""

    mean: float
    low: float | None
    high: float | None
    n: int


def mean_over_groups(groups: Sequence[Sequence[float]]) -> Estimate:
    """The mean over groups (worlds) of the mean within each (over seeds), every group with the same weight.

    The groups are fixed, the values within them drawn: a group of n values adds the variance s²/n of its own mean. The
    sum has about f degrees of freedom (Welch 1947, Satterthwaite 1946), which are n - 1 for one group alone.

    A sample that shows no spread at all says nothing of its size either: there is no interval.
    """
    filled = [np.asarray(group, dtype=float) for group in groups if len(group)]
    count = sum(map(len, filled))
    if not count:
        return Estimate(math.nan, None, None, 0)
    mean = float(np.mean([group.mean() for group in filled]))
    if min(map(len, filled)) < FEWEST:
        return Estimate(mean, None, None, count)
    parts = np.array([group.var(ddof=1) / len(group) for group in filled]) / len(filled) ** 2
    variance = parts.sum()
    # values that are equal differ by rounding once they have been summed
    if variance <= (1e-12 * max(1.0, abs(mean))) ** 2:
        return Estimate(mean, None, None, count)
    freedom = variance**2 / (parts**2 / [len(group) - 1 for group in filled]).sum()
    margin = float(stats.t.ppf((1 + LEVEL) / 2, freedom) * np.sqrt(variance))
    return Estimate(mean, mean - margin, mean + margin, count)


def iqm(groups: Sequence[Sequence[float]]) -> float:
    """The mean over groups of the interquartile mean within each: one hard group is not trimmed away as a whole.

    A quarter of the values, rounded down, is left out at each end of a group.
    """
    return float(np.mean([stats.trim_mean(group, 0.25) for group in groups if len(group)] or [math.nan]))


def share(part: int, whole: int) -> Estimate:
    """`part` of `whole` trials with the interval of Clopper and Pearson (1934), which covers at every n.

    None of n seen still allows for about 3/n: the interval ends there, not at 0. Trials of unlike chances, as runs
    in several worlds are, spread less than the binomial law says (Hoeffding 1956), so it holds for them as well.
    """
    if not whole:
        return Estimate(math.nan, None, None, 0)
    if whole < FEWEST:
        return Estimate(part / whole, None, None, whole)
    found = stats.binomtest(part, whole).proportion_ci(LEVEL, method="exact")
    return Estimate(part / whole, float(found.low), float(found.high), whole)
