"""Valuing a policy on recorded tracks: it is replayed on every one of them, since sensing does not move the target."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve_triangular

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.renewal import IndexArray
from trackmdp.statistics import MeanInterval, ratio
from trackmdp.world.model import Array, Task
from trackmdp.world.tracks import Recorded, Tracks

__all__ = ["ReplayedTracks", "evaluate_recorded", "replay"]


@dataclass(frozen=True)
class ReplayedTracks:
    """What a policy earned and did on K tracks, each from its first cell to its end.

    Attributes:
        totals: `[K, 5]` reward, steps in the grid, detections, sensors on by choice, safe actions; expected ones where
            the policy draws or a sensor may miss.
        length: `[K]` steps, the exit step included.
    """

    totals: Array
    length: Array

    def evaluation(self, starts: IndexArray, num_cells: int) -> Evaluation:
        """The figures of all tracks together, and by start cell, nan where no track starts; `starts` is `[K]`."""
        together = pooled(self.totals, self.length)
        count = np.bincount(starts, minlength=num_cells)
        with np.errstate(invalid="ignore"):
            # 0 / 0 is nan on purpose: no track starts there, and 0 would read as a worth.
            by_cell = [np.bincount(starts, weights, num_cells) / count for weights in self.totals.T]
        value, steps, detections, sensors, safe = by_cell
        return Evaluation(
            aihtr=together.aihtr,
            value=value,
            accuracy=together.accuracy,
            sensors_per_step=together.sensors_per_step,
            safe_per_episode=together.safe_per_episode,
            expected_length=together.expected_length,
            steps=steps,
            detections=detections,
            sensors=sensors,
            safe_actions=safe,
        )

    def intervals(self) -> dict[str, MeanInterval]:
        """Figure -> its mean and interval, the tracks taken as independent."""
        reward, steps, detections, sensors, safe = self.totals.T
        one = np.ones_like(steps)
        return {
            "aihtr": ratio(reward, one),
            "reward_per_step": ratio(reward, self.length),
            "accuracy": _complement(ratio(steps - detections, steps, events=True)),
            "sensors_per_step": ratio(sensors, steps),
            "safe_per_episode": ratio(safe, one, events=True),
            "expected_length": ratio(self.length, one),
        }


def evaluate_recorded(problem: Recorded, policy: PolicyTable) -> Evaluation:
    """The figures of `policy` on the held-out tracks, each from its first cell to its end or `max_steps`."""
    tracks = problem.held_out.limited(problem.max_steps)
    starts = tracks.cells[tracks.first[:-1]]
    return replay(problem, tracks, policy).evaluation(starts, problem.num_cells)


def replay(task: Task, tracks: Tracks, policy: PolicyTable) -> ReplayedTracks:
    """Follow `policy` along every track, from its first cell.

    Every point of the recording is taken as one where the target may be located; what follows up to the next detection
    is known from the recording, so that one triangular system tells which points are reached.
    """
    m = task.num_cells
    line = tracks.closed(m)
    points = len(line.cells)
    track = np.repeat(np.arange(len(line)), np.diff(line.first))
    last = line.first[1:][track] - 1
    figures, hits = _renewals(task, line.cells, last, policy)
    reached = np.zeros(points)
    reached[line.first[:-1]] = 1.0
    # Point p of the recording is reached with probability reached[p]; located there, the plan is missed up to the next
    # detection at a later point of the same track. So reached = first points + onward^T reached, which is triangular.
    start, end, weight = hits
    onward = sparse.csr_array((weight, (end, start)), shape=(points, points))
    reached = spsolve_triangular(sparse.eye_array(points, format="csr") - onward, reached, unit_diagonal=True)
    sums = np.stack([np.bincount(track, reached * figure, len(line)) for figure in figures], axis=1)
    return ReplayedTracks(sums[:, :5].astype(np.float64), sums[:, 5].astype(np.float64))


def _renewals(
    task: Task, cells: IndexArray, last: IndexArray, policy: PolicyTable
) -> tuple[list[Array], tuple[IndexArray, IndexArray, Array]]:
    """From every point, located there, to the next detection or the end of the track.

    Returns:
        Six `[P]`, the columns of `ReplayedTracks.totals` and the steps; and the detections as a sparse matrix: from
        which point, at which one, with what probability.
    """
    m, points = task.num_cells, np.arange(len(cells))
    figures, hits = np.zeros((6, len(cells))), []
    at, undetected = points[cells < m], np.ones(int((cells < m).sum()))
    for n in itertools.count():  # beyond t_max + 1 only where the safe action may miss
        # at: points whose plan is still running after n misses; `undetected`: with what probability
        going = (at + n + 1 <= last[at]) & (undetected > 0)
        at, undetected = at[going], undetected[going]
        if not len(at):
            break
        cell = cells[at + n + 1]
        inside = cell < m
        # the exit is a step as well, and costs nothing; a recording that stops has none (`Tracks.closed`)
        figures[5, at] += undetected
        at, undetected, cell = at[inside], undetected[inside], cell[inside]
        if n < task.num_choices:
            sensed = policy.on(n, cells[at], cell) * task.detects(cell)
            sensors, price = (policy.spent(n, each)[cells[at]] for each in (np.ones(task.num_cells), task.cost))
            safe: float | Array = 0.0
        else:
            sensed, sensors, safe = task.safe_detection[cell], np.zeros(len(at)), 1.0
            price = np.full(len(at), task.safe_cost)
        for row, amount in enumerate((task.reward * sensed - price, 1.0, sensed, sensors, safe)):
            figures[row, at] += undetected * amount
        found = sensed > 0
        hits.append((at[found], (at + n + 1)[found], (undetected * sensed)[found]))
        undetected = undetected * (1.0 - sensed)
    start, end, weight = (np.concatenate(part) for part in zip(*hits, strict=True))
    return list(figures), (start, end, weight)


def _complement(missed: MeanInterval) -> MeanInterval:
    """1 less a share, with its interval."""
    low, high = (None if end is None else 1.0 - end for end in (missed.high, missed.low))
    return MeanInterval(1.0 - missed.mean, None if low is None else max(low, 0.0), high, missed.n)
