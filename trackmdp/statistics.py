"""Intervals that cover at small n: Student's t over seeds, Clopper and Pearson's for shares, bootstrap-t for ratios."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from trackmdp.seeding import derive

Values: TypeAlias = npt.NDArray[np.float64]

LEVEL = 0.95
"""Nominal coverage of every interval."""
RESAMPLES, _FEW, _MANY = 999, 8, 2000
"""Of the bootstrap; units below which Student's t serves, as many resamples hold one unit or two alike, whose spread is
next to none; and units above which the bootstrap is not needed."""
FEWEST = 3
"""Values a group needs before an interval is shown: from two, its width depends more on luck than on the spread."""


@dataclass(frozen=True)
class MeanInterval:
    """A mean of `n` values with its 95 % interval; `low` and `high` are None where too few values stand behind it."""

    mean: float
    low: float | None
    high: float | None
    n: int


def mean_over_groups(groups: Sequence[Sequence[float]]) -> MeanInterval:
    """The mean over groups (worlds) of the mean within each (over seeds), every group with the same weight.

    The groups are fixed, the values within them drawn: a group of n values adds the variance s²/n of its own mean. The
    sum has about f degrees of freedom (Welch 1947, Satterthwaite 1946), which are n - 1 for one group alone.

    A sample without any spread is no estimate of the spread: there is no interval.
    """
    filled = [np.asarray(group, float) for group in groups if len(group)]
    count = sum(map(len, filled))
    if not count:
        return MeanInterval(math.nan, None, None, 0)
    mean = float(np.mean([group.mean() for group in filled]))
    if min(map(len, filled)) < FEWEST:
        return MeanInterval(mean, None, None, count)
    # The mean of G group means has the variance Σ_g v_g with v_g = s_g² / (n_g G²), s_g² the variance within group g.
    parts = np.array([group.var(ddof=1) / len(group) for group in filled]) / len(filled) ** 2
    variance = parts.sum()
    # values that are equal differ by rounding once they have been summed
    if variance <= (1e-12 * max(1.0, abs(mean))) ** 2:
        return MeanInterval(mean, None, None, count)
    # Welch-Satterthwaite: ν = (Σ v_g)² / Σ (v_g² / (n_g - 1)). For G = 1 that is n - 1; for G equal groups of n it is
    # G (n - 1).
    freedom = variance**2 / (parts**2 / [len(group) - 1 for group in filled]).sum()
    margin = student(freedom) * math.sqrt(variance)
    return MeanInterval(mean, mean - margin, mean + margin, count)


def iqm(groups: Sequence[Sequence[float]]) -> float:
    """The mean over groups of the interquartile mean within each: one hard group is not trimmed away as a whole.

    A quarter of the values, rounded down, is left out at each end of a group.
    """
    # Of 10 values 10 // 4 = 2 are left out at each end, of 3 none.
    trimmed = [
        np.sort(group)[len(group) // 4 : len(group) - len(group) // 4].mean()
        for group in groups
        if len(group)
    ]
    return float(np.mean(trimmed)) if trimmed else math.nan


def share(part: int, whole: int) -> MeanInterval:
    """`part` of `whole` trials with the interval of Clopper and Pearson (1934), which covers at every n.

    None of n seen still allows for about 3.7/n: the interval ends there, not at 0. Trials of unlike chances, as runs
    in several worlds are, spread less than by the binomial law (Hoeffding 1956), so it holds for them as well.
    """
    if not whole:
        return MeanInterval(math.nan, None, None, 0)
    if whole < FEWEST:
        return MeanInterval(part / whole, None, None, whole)
    from scipy.special import betaincinv  # a quarter of a second to load

    # The limits solve P(X >= k | low) = α/2 and P(X <= k | high) = α/2 for X ~ Binomial(n, p). By the identity of
    # binomial tails and the incomplete beta function, low is the α/2 quantile of Beta(k, n - k + 1) and high the 1 -
    # α/2 quantile of Beta(k + 1, n - k). At k = 0: high = 1 - (α/2)^(1/n), about -ln(0.025)/n = 3.7/n.
    tail = (1 - LEVEL) / 2
    low = float(betaincinv(part, whole - part + 1, tail)) if part else 0.0
    high = float(betaincinv(part + 1, whole - part, 1 - tail)) if part < whole else 1.0
    return MeanInterval(part / whole, low, high, whole)


def ratio(part: Values, whole: Values, *, events: bool = False) -> MeanInterval:
    """Σ part / Σ whole over independent units `[n]`, such as tracks, with its bootstrap-t interval (Efron 1979).

    Ratios of a few dozen units are skewed, and Student's t on them covers .8 to .9 only; the bootstrap takes the shape
    of the t statistic from the units themselves, and the interval holds Student's. Below `_FEW` units, or above
    `_MANY`, it is Student's.

    Args:
        part: `[n]`, the sum of each unit.
        whole: `[n]`, the denominator of each unit.
        events: `part` counts events that may be rare. Where fewer than `_FEW` units have some, or there is no spread to
            resample, the interval is widened to that of the share of units with any, at their events per unit.
    """
    count, total = len(part), float(whole.sum())
    if not total:
        return MeanInterval(math.nan, None, None, count)
    mean = float(part.sum() / total)
    if count < FEWEST:
        return MeanInterval(mean, None, None, count)
    low, high = _bootstrap_t(part, whole, mean)
    having = part > 1e-9  # more than rounding
    if events and (having.sum() < _FEW or low == high):
        # Example: 40 tracks, none with a safe action. The bootstrap resamples zeros and would end at 0; the share of
        # tracks that have one may be up to 8.8 %, each with one event (`size`), over `total` steps.
        known = share(int(having.sum()), count)
        size = float(part[having].mean()) if having.any() else 1.0
        low = min(low, (known.low or 0.0) * size * count / total)
        high = max(high, (known.high or 1.0) * size * count / total)
    low = max(low, 0.0) if events else low
    return MeanInterval(mean, low, high, count)


def _bootstrap_t(part: Values, whole: Values, mean: float) -> tuple[float, float]:
    """The ends mean - t e, t the quantiles of (resampled - mean) / (its own error)."""
    count = len(part)
    rest = part - mean * whole
    # Delta method: part/whole - mean ≈ mean(part - mean·whole) / mean(whole), a mean over n units.
    error = float(rest.std(ddof=1) / (whole.mean() * math.sqrt(count)))
    if not _FEW <= count <= _MANY or not error:
        return _by_student(mean, error, count)
    rng = np.random.default_rng(derive(0, "bootstrap"))
    # `[resamples, n]`: how often each unit is in each resample, so that all resampled sums are one matrix product. The
    # generator is seeded with a constant: the same figures give the same interval in every report.
    weights = rng.multinomial(count, np.full(count, 1 / count), size=RESAMPLES).astype(np.float64)
    base = weights @ whole
    # A resample may hold units of `whole` = 0 only: its ratio is nan, and it is left out below.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = (weights @ part) / base
        # Σ w (part - r whole)² from the three sums of squares, so that no [resamples, n] array is made again
        squares = (
            weights @ part**2
            - 2 * ratios * (weights @ (part * whole))
            + ratios**2 * (weights @ whole**2)
        )
        # Of units that are all alike rounding is left over.
        squares[squares <= 1e-12 * (weights @ part**2)] = 0.0
        statistic = (ratios - mean) / (np.sqrt(squares * count / (count - 1)) / base)
    spread = np.isfinite(statistic)
    if 1.0 - spread.mean() > (1 - LEVEL) / 2:  # the quantile would be one of those without any
        return _by_student(mean, error, count)
    low, high = np.quantile(statistic[spread], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    # Where most units are 0, as differences of like policies are, the quantiles alone cover .86 to .91.
    margin = student(count - 1)
    low, high = min(low, -margin), max(high, margin)
    # The quantiles change sides: t = (estimate - truth) / error is at most `high` exactly where truth is at least
    # estimate - high·error.
    return float(mean - high * error), float(mean - low * error)


def _by_student(mean: float, error: float, count: int) -> tuple[float, float]:
    """The ends of Student's interval."""
    margin = student(count - 1) * error
    return mean - margin, mean + margin


def student(freedom: float) -> float:
    """The quantile (1 + `LEVEL`) / 2 of Student's t."""
    from scipy.special import stdtrit  # a quarter of a second to load

    return float(stdtrit(freedom, (1 + LEVEL) / 2))
