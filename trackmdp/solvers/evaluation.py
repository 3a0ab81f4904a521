"""What a policy earns and does: the figures of an evaluation, however they were found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


def pooled(totals: Array, length: Array, error: float = 0.0) -> Evaluation:
    """An evaluation from `[M, 5]` reward, steps in the grid, detections, sensors, safe actions per episode.

    `length` `[M]` is the expected number of steps of an episode, the exit step included.
    """
    value, steps, detections, sensors, safe = totals.T
    means = [float(each.mean()) for each in (detections, sensors, safe)]
    return summed_up(value, steps, length, means, error, parts=(detections, sensors, safe))


def summed_up(
    value: Array,
    steps: Array,
    length: Array,
    means: Sequence[float],
    error: float,
    *,
    parts: tuple[Array | None, Array | None, Array | None] = (None, None, None),
) -> Evaluation:
    """An evaluation from what is known of each start cell and the `means` of detections, sensors and safe actions."""
    # Ratios of means, not means of ratios: pooled over a uniform start, a long episode counts for all of its steps.
    in_grid = float(steps.mean())
    detections, sensors, safe = means
    return Evaluation(
        aihtr=float(value.mean()),
        value=value,
        accuracy=detections / in_grid if in_grid else 1.0,
        sensors_per_step=sensors / in_grid if in_grid else 0.0,
        safe_per_episode=safe,
        expected_length=float(length.mean()),
        steps=steps,
        detections=parts[0],
        sensors=parts[1],
        safe_actions=parts[2],
        error=error,
    )
