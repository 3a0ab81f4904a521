"""One policy after another along the same tracks: all that may happen is found once, each policy's events among it."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order

from trackmdp.arrays.types import BoolArray, IndexArray
from trackmdp.memory.keys import KeySpace
from trackmdp.motion.chain import Motion
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluation import Evaluation
from trackmdp.solvers.value import first_events, value_of
from trackmdp.solvers.walk import Events, Reports, Walk, all_events

_MOST = 2**21
"""Events whose followers are kept, some 100 bytes each."""


class Reach:
    """All events along tracks, and where each leads.

    Args:
        task: its t_max and its safe action.
        keys: of the policies.
        motion: along tracks.
    """

    def __init__(self, task: Task, keys: KeySpace, motion: Motion) -> None:
        self.keys, self._motion, self._choices = keys, motion, task.num_choices
        self._events = all_events(task, keys, motion)
        walk = Walk(task, motion, self._events)
        self._steps = [walk.move() for _ in range(task.num_choices + 1)]

    def under(self, reports: Reports) -> Events:
        """The events that can follow an episode's start where a report has this probability; see `all_events`."""
        events, count = self._events, len(self._events.codes)
        starts = first_events(events, self._motion)
        pairs = [(np.full(len(starts), count), starts)]  # a node before all of them
        undetected: BoolArray = np.ones(count, dtype=bool)
        for step in self._steps:
            # Along a track an event has one entry in each step, or none where the track has ended.
            here = found = undetected[step.rows]
            if step.n < self._choices:
                report = reports(step.n, events.key[step.rows], self._motion.cell[step.states])
                found = here & (report > 0)
                undetected[step.rows] = here & (report < 1)
            pairs.append((step.rows[found], step.following[found]))
            if step.missed is not None:
                pairs.append((step.rows[here], step.missed[here]))
        reached = breadth_first_order(_graph(pairs, count + 1), count, return_predecessors=False)
        return Events(events.keys, events.states, events.codes[np.sort(reached[1:])])


def _graph(pairs: list[tuple[IndexArray, IndexArray]], count: int) -> sparse.csr_array:
    source, target = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return sparse.csr_array((np.ones(len(source)), (source, target)), shape=(count, count))


class Replays:
    """Values policies on the held-out tracks of a problem, as `value_of` does.

    With a memory the first one takes as long, and each other one a fraction of that.
    """

    def __init__(self, problem: Recorded) -> None:
        self._problem, self._motion = problem, problem.motion
        self._reach: Reach | None = None

    def value(self, policy: PolicyTable) -> Evaluation:
        """The figures of a policy."""
        keys = policy.task.keys
        if keys.order == 0 or self._motion.num_states * _most_keys(keys) > _MOST:
            return value_of(self._problem, policy)
        if self._reach is None or self._reach.keys != keys:
            self._reach = Reach(self._problem, keys, self._motion)
        return value_of(self._problem, policy, under=self._reach.under)


def _most_keys(keys: KeySpace) -> int:
    """Keys with which a point of a track may be located, where no safe action misses."""
    gaps = (keys.t_max + 2) ** keys.order
    return min(gaps, keys.num_classes)
