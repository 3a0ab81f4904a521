"""Valuing a policy on recorded tracks: it is replayed on every one of them, since sensing does not move the target."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve_triangular

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluation import Evaluation, pooled
from trackmdp.solvers.renewal import IndexArray
from trackmdp.statistics import MeanInterval, ratio
from trackmdp.world.memory import KeySpace
from trackmdp.world.model import Array, BoolArray, Task
from trackmdp.world.tracks import Recorded, Tracks


@dataclass(frozen=True)
class Events:
    """All that a policy may know when it locates the target at a point of K tracks: S states of (point, key).

    A key follows from where the target was at the last detections: at this point, g points earlier, and, where two
    displacements are remembered, g' points before that. With G = t_max + 3 values of a gap, 0 for a detection that
    there was not, state p · G² + g · G + g' is that of point p; with one displacement p · G + g, and where the cell
    alone is remembered the states are the points.

    Attributes:
        line: the tracks, each closed by the exit.
        keys: of the policies that are replayed.
        point: `[S]`.
        key: `[S]`, only where `possible`.
        possible: `[S]` whether the target is in the grid, and the gaps lead to no point before the track's first.
        last: `[S]`, the last point of the state's track.
    """

    line: Tracks
    keys: KeySpace
    point: IndexArray
    key: IndexArray
    possible: BoolArray
    last: IndexArray

    @classmethod
    def of(cls, tracks: Tracks, keys: KeySpace) -> Events:
        """The states of all points of `tracks`."""
        cells = keys.size[0] * keys.size[1]
        line = tracks.closed(cells)
        track = np.repeat(np.arange(len(line)), np.diff(line.first))
        gaps, order = keys.t_max + 3, keys.order
        point = np.repeat(np.arange(len(line.cells)), gaps**order)
        begin, last = line.first[:-1][track][point], line.first[1:][track][point] - 1
        possible = line.cells[point] < cells
        # Going back from the last detection: the gap before it, then the one before that.
        code, at, back = np.tile(np.arange(gaps**order), len(line.cells)), point, []
        for digit in range(order - 1, -1, -1):
            gap = code // gaps**digit % gaps
            # No detection before this one: it is the track's first point. Else its gap leads to an earlier one.
            possible &= np.where(gap == 0, at == begin, at - gap >= begin)
            back.append((at, gap))
            at = np.maximum(at - gap, begin)
        # Forward again, as the policy does.
        key = keys.start(line.cells[at])
        for after, gap in reversed(back):
            key = np.where(gap > 0, keys.next(key, gap - 1, line.cells[after]), key)
        return cls(line, keys, point, key, possible, last)

    @property
    def first(self) -> IndexArray:
        """`[K]`, the states in which the tracks begin."""
        return self.line.first[:-1] * self._gaps

    @property
    def _gaps(self) -> int:
        return (self.keys.t_max + 3) ** self.keys.order

    def follow(self, states: IndexArray, misses: int) -> IndexArray:
        """The states after `misses` and a detection."""
        gap, codes = misses + 1, self._gaps
        at = (self.point[states] + gap) * codes
        if self.keys.order == 0:
            return at
        # Of (g, g') the gap g becomes the earlier one: with G = 4 and 1 miss, code 2 · 4 + 3 becomes 2 · 4 + 2.
        oldest = self.keys.t_max + 3
        return at + gap * (codes // oldest) + states % codes // oldest


@dataclass(frozen=True)
class ReplayedTracks:
    """What a policy earned and did on K tracks, each from its first cell to its end.

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
        together = pooled([*self.totals.T, self.length])
        count = np.bincount(starts, minlength=num_cells)
        with np.errstate(invalid="ignore"):
            # 0 / 0 is nan on purpose: no track starts there, and 0 would read as a worth.
            by_cell = [np.bincount(starts, weights, num_cells) / count for weights in self.totals.T]
        value, steps, detections, sensors, safe = by_cell
        return replace(together, value=value, steps=steps, detections=detections, sensors=sensors, safe_actions=safe)

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
            "accuracy": _complement(ratio(steps - detections, steps, events=True)),
            "sensors_per_step": ratio(sensors, steps),
            "safe_per_episode": ratio(safe, tracks, events=True),
            "expected_length": ratio(length, tracks),
        }


def evaluate_recorded(problem: Recorded, policy: PolicyTable) -> Evaluation:
    """The figures of `policy` on the held-out tracks, each from its first cell to its end or `max_steps`."""
    tracks = problem.held_out.limited(problem.max_steps)
    starts = tracks.cells[tracks.first[:-1]]
    return replay(problem, tracks, policy).evaluation(starts, problem.num_cells)


def replay(task: Task, tracks: Tracks, policy: PolicyTable) -> ReplayedTracks:
    """Follow `policy` along every track, from its first cell.

    Every point of the recording is taken as one where the target may be located, knowing all that the policy may know
    there (`Events`); what follows up to the next detection is known from the recording, so that one triangular system
    tells which points are reached.
    """
    events = Events.of(tracks, policy.task.keys)
    states = len(events.point)
    figures, hits, plans = _renewals(task, events, policy)
    reached = np.zeros(states)
    reached[events.first] = 1.0
    # State s of the recording is reached with probability reached[s]; located there, the plan is missed up to the next
    # detection at a later point of the same track. So reached = first states + onward^T reached, which is triangular.
    start, end, weight = hits
    onward = sparse.csr_array((weight, (end, start)), shape=(states, states))
    reached = spsolve_triangular(sparse.eye_array(states, format="csr") - onward, reached, unit_diagonal=True)
    track = np.searchsorted(events.line.first, events.point, side="right") - 1
    sums = np.stack([np.bincount(track, reached * figure, len(tracks)) for figure in figures], axis=1)
    # How often each row of the policy's table was used, key by key and n by n.
    used = np.zeros((policy.task.num_keys, task.num_choices))
    for n, (at, undetected) in enumerate(plans[: task.num_choices]):
        used[:, n] = np.bincount(events.key[at], reached[at] * undetected, len(used))
    return ReplayedTracks(sums[:, :5].astype(np.float64), sums[:, 5].astype(np.float64), policy.watched(used.ravel()))


def _renewals(
    task: Task, events: Events, policy: PolicyTable
) -> tuple[list[Array], tuple[IndexArray, IndexArray, Array], list[tuple[IndexArray, Array]]]:
    """From every state, located there, to the next detection or the end of the track.

    Returns:
        Six `[S]`, the columns of `ReplayedTracks.totals` and the steps; and the detections as a sparse matrix: from
        which state, to which one, with what probability; and for each n the states whose target is then still in the
        grid and undetected, with what probability.
    """
    m, cells, point = task.num_cells, events.line.cells, events.point
    figures, hits = np.zeros((6, len(point))), []
    plans: list[tuple[IndexArray, Array]] = []
    at = np.flatnonzero(events.possible)
    undetected = np.ones(len(at))
    for n in itertools.count():  # beyond t_max + 1 only where the safe action may miss
        # at: states whose plan is still running after n misses; `undetected`: with what probability
        going = (point[at] + n + 1 <= events.last[at]) & (undetected > 0)
        at, undetected = at[going], undetected[going]
        if not len(at):
            break
        cell = cells[point[at] + n + 1]
        inside = cell < m
        # the exit is a step as well, and costs nothing; a recording that stops has none (`Tracks.closed`)
        figures[5, at] += undetected
        at, undetected, cell = at[inside], undetected[inside], cell[inside]
        plans.append((at, undetected))
        if n < task.num_choices:
            key = events.key[at]
            sensed = policy.on(n, key, cell) * task.detects(cell)
            sensors, price = (policy.spent(n, each)[key] for each in (np.ones(task.total_sensors), task.cost))
            safe: float | Array = 0.0
        else:
            sensed, sensors, safe = task.safe_detection[cell], np.zeros(len(at)), 1.0
            price = np.full(len(at), task.safe_cost)
        for row, amount in enumerate((task.reward * sensed - price, 1.0, sensed, sensors, safe)):
            figures[row, at] += undetected * amount
        found = sensed > 0
        hits.append((at[found], events.follow(at[found], n), (undetected * sensed)[found]))
        undetected = undetected * (1.0 - sensed)
    start, end, weight = (np.concatenate(part) for part in zip(*hits, strict=True))
    return list(figures), (start, end, weight), plans


def _complement(missed: MeanInterval) -> MeanInterval:
    """1 less a share, with its interval."""
    low, high = (None if end is None else 1.0 - end for end in (missed.high, missed.low))
    return MeanInterval(1.0 - missed.mean, None if low is None else max(low, 0.0), high, missed.n)
