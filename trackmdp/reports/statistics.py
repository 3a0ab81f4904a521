"""Statistics over few seeds (Agarwal et al. 2021): interquartile means, bootstrap intervals, performance profiles."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from trackmdp.seeding import derive
from trackmdp.world.model import Array

__all__ = ["LEVEL", "Estimate", "estimate", "iqm", "profile"]

LEVEL = 0.95


@dataclass(frozen=True)
class Estimate:
    """An interquartile mean of `n` runs with its bootstrap interval; no interval where no group has two runs."""

    mean: float
    low: float | None
    high: float | None
    n: int


def iqm(values: Array, axis: int = -1) -> Array:
    """Interquartile mean: the mean without the lowest and the highest quarter, each rounded down."""
    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def estimate(groups: Sequence[Sequence[float]], *names: str, resamples: int) -> Estimate:
    """The interquartile mean over all groups; the bootstrap draws runs anew within each group.

    Args:
        groups: values of the runs, one group per world.
        names: of the bootstrap's stream of random numbers.
        resamples: of the bootstrap.
    """
    filled = [np.asarray(group, dtype=float) for group in groups if len(group)]
    everything = np.concatenate(filled) if filled else np.zeros(0)
    if not len(everything):
        return Estimate(float("nan"), None, None, 0)
    interval = _interval(filled, iqm, resamples, *names)
    low, high = (None, None) if interval is None else (float(interval[0]), float(interval[1]))
    return Estimate(float(iqm(everything)), low, high, len(everything))


def profile(groups: Sequence[Sequence[float]], levels: Array, *names: str, resamples: int) -> tuple[Array, Array]:
    """Performance profile: the share of runs whose value is at most each of `levels` `[L]`.

    Returns:
        The share `[L]`, and the bootstrap interval `[2, L]` (the share itself where no group has two runs).
    """
    filled = [np.asarray(group, dtype=float) for group in groups if len(group)]
    share = np.mean(np.concatenate(filled)[:, None] <= levels, axis=0)
    bounds = []
    for level in levels:
        below = [(values <= level).astype(float) for values in filled]
        bounds.append(_interval(below, np.mean, resamples, *names))
    if any(each is None for each in bounds):
        return share, np.stack([share, share])
    return share, np.array([each for each in bounds if each is not None]).T


def _interval(groups: Sequence[Array], statistic: object, resamples: int, *names: str) -> tuple[float, float] | None:
    """Percentile interval of a statistic of all groups together; groups of one run stay as they are."""
    single = np.concatenate([group for group in groups if len(group) == 1] or [np.zeros(0)])
    several = [group for group in groups if len(group) > 1]
    if not several:
        return None
    if len({float(value) for group in several for value in group}) == 1 and not len(single):
        return float(several[0][0]), float(several[0][0])

    def together(*resampled: Array, axis: int) -> Array:
        shape = (*resampled[0].shape[:-1], len(single))
        return np.asarray(statistic(np.concatenate([*resampled, np.broadcast_to(single, shape)], axis=-1), axis=axis))  # type: ignore[operator]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)  # all resamples alike: an interval of length 0
        found = stats.bootstrap(
            several,
            together,
            n_resamples=resamples,
            confidence_level=LEVEL,
            method="percentile",
            vectorized=True,
            axis=-1,
            rng=np.random.default_rng(derive(0, "report", *names)),
        ).confidence_interval
    return float(found.low), float(found.high)
