"""Figures of simulated episodes: means over them, each with its standard error."""

from __future__ import annotations

import math
from dataclasses import dataclass

from trackmdp.arrays.types import Array


@dataclass(frozen=True)
class MeanEstimate:
    """A mean over simulated episodes with its standard error (nan for a single episode)."""

    mean: float
    standard_error: float


@dataclass(frozen=True)
class Simulation:
    """Figures of simulated episodes.

    Figures per step are ratios of sums over all episodes; their standard errors are those of a ratio estimate.
    """

    episodes: int
    aihtr: MeanEstimate
    accuracy: MeanEstimate
    sensors_per_step: MeanEstimate
    safe_per_episode: MeanEstimate
    expected_length: MeanEstimate


def mean_ratio(part: Array, whole: Array) -> MeanEstimate:
    """Σ part / Σ whole; its standard error by the delta method.

    The ratio R = mean(p) / mean(w) errs to first order by mean(p - R w) / mean(w), a mean over episodes.
    """
    if not whole.any():
        return MeanEstimate(math.nan, math.nan)
    ratio = float(part.sum() / whole.sum())
    residual = part - ratio * whole
    scale = float(whole.mean()) * math.sqrt(len(part))
    return MeanEstimate(ratio, float(residual.std(ddof=1)) / scale if len(part) > 1 else math.nan)
