"""What simulated episodes say of a policy: means over episodes, each with its standard error."""

from __future__ import annotations

import math
from dataclasses import dataclass

from trackmdp.world.model import Array


@dataclass(frozen=True)
class MeanEstimate:
    """A mean over simulated episodes with its standard error (nan for a single episode)."""

    mean: float
    standard_error: float


@dataclass(frozen=True)
class Simulation:
    """Figures of simulated episodes; `accuracy` is pooled, as the exact one, `episode_accuracy` the mean over episodes.

    Figures per step are ratios of sums over all episodes; their standard errors are those of a ratio estimate.
    """

    episodes: int
    aihtr: MeanEstimate
    accuracy: MeanEstimate
    episode_accuracy: MeanEstimate
    sensors_per_step: MeanEstimate
    safe_per_episode: MeanEstimate
    expected_length: MeanEstimate


def summary(totals: Array) -> Simulation:
    """The figures of E episodes from `[6, E]` sums over their steps.

    The rows of `totals` are reward, steps in the grid, detections, sensors on by choice, safe actions, and steps.
    """
    reward, steps, detections, sensors, forced, length = totals
    # An episode whose first step is the exit has no step in the grid, and no accuracy.
    some = steps > 0
    return Simulation(
        episodes=len(reward),
        aihtr=_mean(reward),
        accuracy=_ratio(detections, steps),
        episode_accuracy=_mean(detections[some] / steps[some]),
        sensors_per_step=_ratio(sensors, steps),
        safe_per_episode=_mean(forced),
        expected_length=_mean(length),
    )


def _mean(values: Array) -> MeanEstimate:
    if len(values) == 0:
        return MeanEstimate(math.nan, math.nan)
    error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return MeanEstimate(float(values.mean()), error)


def _ratio(part: Array, whole: Array) -> MeanEstimate:
    """Σ part / Σ whole; its standard error by the delta method.

    The ratio R = mean(p) / mean(w) errs to first order by mean(p - R w) / mean(w), a mean over episodes.
    """
    if not whole.any():
        return MeanEstimate(math.nan, math.nan)
    ratio = float(part.sum() / whole.sum())
    residual = part - ratio * whole
    scale = float(whole.mean()) * math.sqrt(len(part))
    return MeanEstimate(ratio, float(residual.std(ddof=1)) / scale if len(part) > 1 else math.nan)
