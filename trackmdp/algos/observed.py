"""Paths from one detection to the next, as a tracker observes them, and whole tracks put together from them.

Only the tracker's observations are read: where and when it located the target, its own sets, and that the target left.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Self

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from tensordict import TensorDictBase
from torch import Tensor

from trackmdp.algos.common import arrays, choosable_places, tensors
from trackmdp.algos.estimates.censored import ObservedPaths, hidden_cells
from trackmdp.algos.estimates.hidden_cells import Missed, redrawn
from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.moves import known_as
from trackmdp.arrays.entries import ends_of, ones_at, row_index
from trackmdp.arrays.types import Array, BoolArray, IndexArray, Indices
from trackmdp.recordings.tracks import Tracks
from trackmdp.seeding import derive
from trackmdp.sensing.coverage import reported
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window
from trackmdp.world.problem_file import as_arrays, from_arrays

_ENDING = 8
"""Cells at the end of a path that identify its recording: wherever a path began, it ends as its recording."""
_STRETCHES, _DRAWS = (8, 10, 13, 18, 27, 40), 16
"""Last cells among which so many random sets of them are compared where some are unknown. Of 502 vehicles followed 24
times each by sensors that miss once in ten, 33 % of the paths had names of their own by cells in a row, 4 % by these;
plans were then judged by recordings that they were learned from, and earned 11.7 less, not 6.4, on others."""
_LONGEST_WAIT = 16
"""Misses of the safe action up to which the cells in between are inferred."""
_UNKNOWN = -(2**40)
"""Safe actions before a path that is not known from its beginning."""
EM_ROUNDS = 100
"""Rounds of expectation-maximisation at most, from the moves seen alone: the result does not depend on earlier ones.
With a budget the likelihood is then that of 400 rounds without leaps, which take four times as long."""


def observed_paths(batch: TensorDictBase, task: Task, *, last: bool = False) -> ObservedPaths:
    """The paths that end in a collected batch `[B, time]`, row by row.

    Where a detection reveals the mode they are of keys, and a sensor sees all those of its cell. Where the safe action
    may miss, a path that comes to it ends with its last set, unless `last`; so does one of an episode that is truncated
    after a miss: to keep the others alone would favour the sensed cells.

    Args:
        batch: of any sets.
        task: its sensors.
        last: whether cells are wanted where there are keys, and where a path ends however often the safe action missed.
    """
    after, name = batch["next"], "last_cell" if last else known_as(batch)
    outside, classes = (task.num_cells, 1) if last else (task.num_keys, task.keys.num_classes)
    found = path_ends(batch)
    cut = after["done"].squeeze(-1) & ~found & (not last)
    ended, clock = found | cut, batch["steps_since_detection"]
    exited, cell = after["terminated"].squeeze(-1), batch["last_cell"][ended]
    misses = torch.where(cut, after["steps_since_detection"], clock)[ended]
    end = torch.where(exited, outside, after[name])[ended]
    forced = (misses == task.num_choices) & (not (task.safe or last))
    end = torch.where(cut[ended] | forced, outside + 1, end)
    # A path's sets are in the history of the step that ended it, wherever the batch began, or of the state in which its
    # episode was truncated. Most paths have no miss.
    missed = misses.nonzero().squeeze(-1)
    history = batch["action_history"][found & (clock > 0) | cut]
    history[cut[ended][missed]] = after["action_history"][cut]
    path, miss, sensor = history.nonzero(as_tuple=True)
    if task.window is not None and task.coverage is None:  # numbered within the window
        sensor = Window.of(task, sensor.device).around(cell[missed])[path, sensor]
    row, sensor = (part.cpu().numpy() for part in (missed[path] * task.num_choices + miss, sensor))
    located = cell.cpu().numpy()[row // task.num_choices]
    there = choosable_places(task, located, sensor)
    shape = (len(misses) * task.num_choices, task.total_sensors)
    sets = ones_at(row[there], sensor[there], shape, np.float64)
    report = reported(sets, task.sees_by_cell.T.tocsr())
    if classes > 1:
        report = sparse.kron(report, np.ones((1, classes)), format="csr")
    parts = [part.cpu().numpy() for part in (batch[name][ended], misses, end)]
    return ObservedPaths(parts[0], parts[1], report, parts[2])


def path_ends(batch: TensorDictBase) -> Tensor:
    """`[B, time]` bool, the steps that locate the target, or in which it leaves."""
    after = batch["next"]
    located: Tensor = after["steps_since_detection"] == 0
    return located | after["terminated"].squeeze(-1)


@dataclass(frozen=True)
class _Sensed(ObservedPaths):
    """Observed paths of targets that are followed.

    Attributes:
        episode: `[K]` number of the episode.
        waits: `[K]` misses of the safe action, < 0 where unknown.
    """

    episode: IndexArray
    waits: IndexArray

    def waiting(self) -> Self:
        """The paths with misses of no set for those of the safe action."""
        if not self.waits.any():
            return self
        # Path k has its rows from k (t_max + 1 + more) on.
        more, rows = int(self.waits.max()), row_index(self.sensed)
        place = (rows + rows // self.choices * more, self.sensed.indices)
        shape = (len(self.start) * (self.choices + more), self.sensed.shape[1])
        sensed = sparse.csr_array((self.sensed.data, place), shape=shape)
        return replace(self, misses=self.misses + self.waits, sensed=sensed)


class SensedPaths:
    """Whole paths put together from batches, each row continuing the last.

    Cells in which the target was not located are unknown. In `tracks` they are drawn from their distribution, given all
    that was observed and the kernel that explains it best (`KernelEstimate`).

    Args:
        task: its sensors.
        capacity: steps kept, in whole batches, the oldest of which go first; None for all.
        seed: of the draws.
    """

    def __init__(self, task: Task, capacity: int | None = None, seed: int = 0) -> None:
        self._task, self._capacity, self._seed = task, capacity, seed
        self._parts: list[_Sensed] = []
        # [B], safe actions of each row's unfinished path.
        self._waiting: IndexArray = np.zeros(0, np.int64)
        self._running = np.zeros(0, np.int64)  # [B], number of the episode of each row
        self._next = 0
        self._tracks: Tracks | None = None

    def __len__(self) -> int:
        return sum(len(part.start) for part in self._parts)

    def extend(self, batch: TensorDictBase) -> None:
        """Add a collected batch `[B, time]`."""
        paths = observed_paths(batch, self._task, last=True)
        done = batch["next", "done"].squeeze(-1).cpu().numpy().astype(np.int64)
        row, time = (part.cpu().numpy() for part in path_ends(batch).nonzero(as_tuple=True))
        begun = np.cumsum(done, axis=1) - done  # episodes of a row before each step
        if not self._continued(row, begun[row, time], paths.start, len(done)):
            self._running = self._next + np.arange(len(done))
            self._next += len(done)
            # Where a row begins with a safe action, nobody knows how many missed before.
            forced = batch["steps_since_detection"][:, 0] == self._task.num_choices
            self._waiting = np.where(forced.cpu().numpy(), _UNKNOWN, 0)
        # Later episodes get new numbers: row by row, for the ones that begin in this batch.
        ends = done.sum(axis=1)
        base = self._next + np.cumsum(ends) - ends
        number = np.where(begun > 0, base[:, None] + begun - 1, self._running[:, None])
        self._running = np.where(ends > 0, base + ends - 1, self._running)
        self._next += int(ends.sum())
        waits = self._waits(batch, done > 0)
        self._parts.append(_Sensed(**vars(paths), episode=number[row, time], waits=waits))
        self._tracks = None
        while self._capacity is not None and len(self) > self._capacity and len(self._parts) > 1:
            del self._parts[0]

    def _waits(self, batch: TensorDictBase, done: BoolArray) -> IndexArray:
        """`[K]` misses of the safe action on each path that ends in a batch: its other steps have other misses.

        Example: of two safe actions after t_max + 1 = 2 misses the second one locates, at the fourth step. There are 3
        misses on the path, and the clock shows 2.
        """
        misses, later = (
            part["steps_since_detection"].cpu().numpy() for part in (batch, batch["next"])
        )
        ended = path_ends(batch).cpu().numpy()
        row, time = np.nonzero(ended | done)
        since = misses[:, 0] + self._waiting
        steps = np.diff(time, prepend=0)
        first = np.diff(row, prepend=-1) > 0
        steps[first] = time[first] + 1 + since[row[first]]
        since += batch.shape[-1]
        since[row] = batch.shape[-1] - 1 - time  # the last one of each row counts
        self._waiting = since - np.where((ended | done)[:, -1], 0, later[:, -1])
        return (steps - 1 - misses[row, time])[ended[row, time]]

    def _continued(self, row: IndexArray, begun: IndexArray, start: IndexArray, rows: int) -> bool:
        """Whether every row goes on as the batch before ended; not so where workers deliver in any order."""
        if not self._parts or len(self._running) != rows:
            return False
        cells = self._task.num_cells
        last = np.full(self._next, cells)
        last[self._parts[-1].episode] = self._parts[-1].end
        first = np.flatnonzero((begun == 0) & (np.diff(row, prepend=-1) > 0))
        before = last[self._running[row[first]]]
        return bool(((before >= cells) | (before == start[first])).all())

    def tracks(self) -> Tracks:
        """All paths so far, the unfinished among them; these count as recordings that stop.

        Paths that end alike have one name: they are taken to follow one recording.
        """
        if self._tracks is None:
            self._tracks = self._joined()
        return self._tracks

    def _joined(self) -> Tracks:
        cells = self._task.num_cells
        paths = _Sensed.of(self._parts, cells)
        order = np.argsort(paths.episode, kind="stable")
        # Else nothing is known of where the target went.
        known = ((paths.waits >= 0) & (paths.waits <= _LONGEST_WAIT))[order]
        paths = paths.pick(order[known]).waiting()
        begins = np.ones(len(paths.start), bool)
        begins[1:] = (np.diff(paths.episode) != 0) | (paths.end[:-1] != paths.start[1:])
        # A path adds its hidden cells and its end, the first one of a track its start as well.
        first = ends_of((paths.misses + 1 + begins).astype(np.int64))
        line = np.full(first[-1], -1)
        line[first[:-1][begins]] = paths.start[begins]
        line[first[1:] - 1] = paths.end
        seen = line >= 0
        track = np.repeat(np.cumsum(begins) - 1, np.diff(first))
        if not seen.all():
            line = self._filled(paths, line, ends_of(np.bincount(track)))
        inside = line < cells
        exits = np.zeros(int(begins.sum()), bool)
        exits[track[~inside]] = True
        ends = ends_of(np.bincount(track[inside], minlength=len(exits)))
        line, seen = line[inside], seen[inside]
        names = _recordings(line, seen, ends).astype(np.int64)
        tracks = Tracks(line, ends, exits, names)
        return tracks.select(~_goes_on(tracks))

    def _filled(self, paths: ObservedPaths, line: Indices, first: Indices) -> IndexArray:
        """The cells of whole paths that begin at places `first`, those that are -1 drawn."""
        task, unknown = self._task, line < 0
        estimate = KernelEstimate(task.size, weight=1.0, exit_weight=1.0, share_cells=None)
        estimate.add(paths)
        estimate.fit(EM_ROUNDS)
        rng = np.random.default_rng(self._seed)
        line[unknown] = hidden_cells(estimate.mean(), paths, rng)
        if task.markov:
            return line
        count = len(first) - 1
        tracks = Tracks(line, first, np.ones(count, bool), np.arange(count))
        return redrawn(task, tracks, unknown, _missed(paths), rng)

    def state_dict(self) -> dict[str, Any]:
        """All that was observed."""
        numbers = {"waiting": self._waiting, "running": self._running, "next": self._next}
        return tensors(numbers) | {
            "parts": [tensors(as_arrays(vars(part))) for part in self._parts]
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        self._parts = [_Sensed(**from_arrays(arrays(part))) for part in state["parts"]]
        self._waiting, self._running = (
            state[name].cpu().numpy() for name in ("waiting", "running")
        )
        self._next, self._tracks = int(state["next"]), None


def _missed(paths: ObservedPaths) -> Missed:
    """The probability that no sensor of its set reported each hidden cell of the paths, path by path."""
    misses = paths.misses.astype(np.int64)
    path = np.repeat(np.arange(len(misses)), misses)
    miss = np.arange(len(path)) - ends_of(misses)[path]
    sensed = paths.sensed[path * paths.choices + miss]

    def missed(number: IndexArray, cells: IndexArray) -> Array:
        row = np.broadcast_to(number[:, None], cells.shape)
        return 1.0 - np.asarray(sensed[row.ravel(), cells.ravel()]).reshape(cells.shape)

    return missed


def _goes_on(tracks: Tracks) -> BoolArray:
    """`[K]`, paths that stop in the grid where another one, the same up to there, goes on.

    Of a recording that was followed to its end they show nothing new. As paths that differ they would count as more
    recordings than there are, and to judge a plan by them is to judge it by what it was learned from.
    """
    pieces = tracks.pieces()
    # In order: a path comes right before one that goes on as it.
    begun = {some for some, more in pairwise(sorted(set(pieces))) if more.startswith(some)}
    return ~tracks.exits & np.array([piece in begun for piece in pieces], np.bool_)


def _recordings(line: Array, seen: BoolArray, first: IndexArray) -> IndexArray:
    """`[K]`, one number for the paths of one recording: paths that share `_ENDING` located cells near their ends.

    Without unknown cells these are the last ones. Else they are random ones of the last `_STRETCHES`, of which each
    path takes those about as long as itself: recordings that leave by one road differ before it.
    """
    count, length = len(first) - 1, np.diff(first)
    rng = np.random.default_rng(derive(0, "recordings"))
    # At least so many: of a short path at most two are left out, of two or three cells none.
    least = np.minimum(_ENDING, np.maximum(length - 2, np.minimum(length, 3)))
    paths, numbers, found = [], [], 0
    stretches = [_ENDING] if seen.all() else np.repeat(_STRETCHES, _DRAWS).tolist()
    for stretch in stretches:
        distance = np.sort(rng.permutation(stretch)[:_ENDING])
        place = first[1:, None] - 1 - distance
        there = place >= first[:-1, None]
        place = np.maximum(place, 0)
        known = (seen[place] | ~there).all(axis=1) & (there.sum(axis=1) >= least)
        whole = np.flatnonzero(known & ((length < 2.5 * stretch) | (stretch == stretches[-1])))
        run = np.where(there, line[place], -1)[whole]  # -1 before a path's beginning
        number = np.unique(run, axis=0, return_inverse=True)[1].ravel()
        paths.append(whole)
        numbers.append(found + number)
        found += number.max(initial=-1) + 1
    pairs = np.concatenate(paths), count + np.concatenate(numbers)
    return connected_components(ones_at(*pairs, (count + found,) * 2), directed=False)[1][
        :count
    ].astype(np.int64)
