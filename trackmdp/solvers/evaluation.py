"""What a policy earns and does: the figures of an evaluation, however they were found."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from trackmdp.world.model import Array


@dataclass(frozen=True)
class Evaluation:
    """What a policy earns; single figures are pooled over a uniform start.

    Attributes:
        aihtr: mean of `value` (paper, Section VII-A).
        value: `[M]`, V(x, 0, ∅), the expected reward of an episode that starts located in x.
        accuracy: detections per step in the grid, forced ones included (y_0 and the exit step do not count).
        sensors_per_step: sensors switched on by free choice per step in the grid; the safe action counts as none.
        safe_per_episode: forced safe actions per episode.
        expected_length: steps per episode, the exit step included.
        steps: `[M]`, steps in the grid per episode from each start cell.
        detections, sensors, safe_actions: `[M]`, the same of these; None where they were not asked for
            (`evaluate`, `per_cell`) and the system was too large to factorise.
        error: no entry of `value` is farther from the exact one; 0 where the system was factorised.
    """

    aihtr: float
    value: Array
    accuracy: float
    sensors_per_step: float
    safe_per_episode: float
    expected_length: float
    steps: Array
    detections: Array | None
    sensors: Array | None
    safe_actions: Array | None
    error: float = 0.0


def regret_per_step(upper_aihtr: float, evaluation: Evaluation) -> float:
    """How far a policy is from `upper_aihtr`, per step of its episodes."""
    return (upper_aihtr - evaluation.aihtr) / evaluation.expected_length


def pooled(totals: Iterable[Array | float], error: float = 0.0) -> Evaluation:
    """An evaluation from what an episode comes to from each start cell, pooled over a uniform start.

    Args:
        totals: reward, steps in the grid, detections, sensors on, safe actions, steps: `[M]` each; or of the third to
            the fifth a mean, where start cells were not told apart.
        error: see `Evaluation`.
    """
    value, steps, detections, sensors, safe, length = map(np.asarray, totals)
    # Ratios of means, not means of ratios: pooled over a uniform start, a long episode counts for all of its steps.
    in_grid = float(steps.mean())
    return Evaluation(
        aihtr=float(value.mean()),
        value=value,
        accuracy=float(detections.mean()) / in_grid if in_grid else 1.0,
        sensors_per_step=float(sensors.mean()) / in_grid if in_grid else 0.0,
        safe_per_episode=float(safe.mean()),
        expected_length=float(length.mean()),
        steps=steps,
        detections=detections if detections.ndim else None,
        sensors=sensors if sensors.ndim else None,
        safe_actions=safe if safe.ndim else None,
        error=error,
    )
