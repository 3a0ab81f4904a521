"""The figures of an evaluation: rewards, detections, sensors, steps, from any method."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from trackmdp.arrays.types import Array, IndexArray
from trackmdp.notebook.card import Card, Carded, Facts, decimal, percent
from trackmdp.statistics import MeanInterval, ratio


@dataclass(frozen=True, repr=False)
class Evaluation(Carded):
    """The figures of a policy; single figures are pooled over a uniform start.

    Attributes:
        aihtr: mean of `value` (paper, Section VII-A).
        value: `[M]`, V(x, 0, ∅), the expected reward of an episode that starts located in x.
        accuracy: detections per step in the grid, forced ones included (y_0 and the exit step do not count).
        sensors_per_step: sensors switched on by free choice per step in the grid; the safe action counts as none.
        safe_per_episode: forced safe actions per episode.
        expected_length: steps per episode, the exit step included.
        steps: `[M]`, steps in the grid per episode from each start cell.
        detections, sensors, safe_actions: `[M]`, the same of these; None where the system was too
            large to factorise.
        error: no entry of `value` is farther from the exact one; 0 where the system was factorised.
        starts: `[F]`, value of each start of an episode: of each hidden state, or of each recorded track.
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
    starts: Array = field(default_factory=lambda: np.zeros(0))

    def card(self) -> Card:
        """AIHTR, accuracy, sensors and lengths."""
        cells = f"{len(self.value):,} start cells" if len(self.value) else "all start cells"
        return Card(f"Evaluation: {cells}", self.facts())

    def facts(self) -> Facts:
        """The figures of the card."""
        found = {"AIHTR": decimal(self.aihtr), "accuracy": percent(self.accuracy)}
        found["sensors per step"] = decimal(self.sensors_per_step, 2)
        found["safe actions per episode"] = decimal(self.safe_per_episode)
        found["steps per episode"] = decimal(self.expected_length, 1)
        known = self.value[~np.isnan(self.value)]  # no recorded track starts in the other cells
        if len(known):
            ends = decimal(float(known.min())), decimal(float(known.max()))
            found["value V(x)"] = f"{ends[0]} to {ends[1]}"
        if self.error:
            found["error"] = f"at most {self.error:.1g} in a value"
        return found


_PER_START = ("value", "steps", "detections", "sensors", "safe_actions", "starts")


def figures(evaluation: Evaluation) -> dict[str, Any]:
    """The single figures of an evaluation, as they stand in `summary.json`."""
    return {key: value for key, value in asdict(evaluation).items() if key not in _PER_START}


def regret_per_step(upper_aihtr: float, evaluation: Evaluation) -> float:
    """How far a policy is from `upper_aihtr`, per step of its episodes."""
    return (upper_aihtr - evaluation.aihtr) / evaluation.expected_length


def pooled(totals: Iterable[Array | float], error: float = 0.0) -> Evaluation:
    """An evaluation from the totals of an episode from each start cell, pooled over a uniform start.

    Args:
        totals: reward, steps in the grid, detections, sensors on, safe actions, steps: `[M]` each; or of the third to
            the fifth a mean, without figures for each start cell.
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
        starts=value,
    )


def by_start(starts: IndexArray, totals: Array, num_cells: int, error: float = 0.0) -> Evaluation:
    """An evaluation from the totals of F episodes, each as likely.

    Args:
        starts: `[F]` cells in which they start.
        totals: `[F, 6]` reward, steps in the grid, detections, sensors on, safe actions, steps.
        num_cells: M; values of cells in which none starts are nan.
        error: see `Evaluation`.
    """
    together = pooled(totals.T, error)
    if len(starts) == num_cells and (np.diff(starts) == 1).all():
        return together
    count = np.bincount(starts, minlength=num_cells)
    with np.errstate(invalid="ignore"):
        # 0 / 0 is nan on purpose: 0 would read as a worth.
        cells = [np.bincount(starts, column, num_cells) / count for column in totals.T[:5]]
    by_cell: dict[str, Any] = dict(zip(_PER_START, cells, strict=False))
    return replace(together, **by_cell)


@dataclass(frozen=True)
class ReplayedTracks:
    """Totals of a policy on K tracks, each from its first cell to its end.

    Attributes:
        totals: `[K, 5]` reward, steps in the grid, detections, sensors on by choice, safe actions; expected ones where
            the policy draws or a sensor may miss.
        length: `[K]` steps, the exit step included.
        watched: `[M]` steps in which each cell was sensed, of all tracks together; the safe action is not counted.
    """

    totals: Array
    length: Array
    watched: Array

    def evaluation(self, starts: IndexArray, num_cells: int) -> Evaluation:
        """The figures of all tracks together, and by start cell, nan where no track starts; `starts` is `[K]`."""
        return by_start(starts, np.column_stack([self.totals, self.length]), num_cells)

    def intervals(self, names: IndexArray) -> dict[str, MeanInterval]:
        """Figure -> its mean over tracks and its interval; `names` `[K]` are those of the targets.

        Targets are taken as independent. Tracks of one name are not: they are pieces of one target's path, cut where
        it was not seen, and counted as so many targets they would make every interval too narrow.
        """
        # Example: the names 4 7 7 are the targets 0 1 1, of which the second has the sums of two tracks.
        target = np.unique(names, return_inverse=True)[1]
        columns = (*self.totals.T, self.length, np.ones(len(names)))
        sums = (np.bincount(target, column).astype(np.float64) for column in columns)
        reward, steps, detections, sensors, safe, length, tracks = sums
        return {
            "aihtr": ratio(reward, tracks),
            "reward_per_step": ratio(reward, length),
            "accuracy": complement(ratio(steps - detections, steps, events=True)),
            "sensors_per_step": ratio(sensors, steps),
            "safe_per_episode": ratio(safe, tracks, events=True),
            "expected_length": ratio(length, tracks),
        }


def complement(missed: MeanInterval) -> MeanInterval:
    """1 less a share, with its interval."""
    low, high = (None if end is None else 1.0 - end for end in (missed.high, missed.low))
    return MeanInterval(1.0 - missed.mean, None if low is None else max(low, 0.0), high, missed.n)
