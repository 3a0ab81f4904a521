"""Paths followed by a policy: its reward on them, and the worth of a detection at each of their points.

A path with all cells known shows the outcome of every policy. At each point where it may locate the target, with
each key that it may then have, the path gives the gain of a sensor n misses later: r + V - W, V the worth of a
detection there and W of a miss, both on this very path. There is no motion model, so nothing needs to be Markov in
the key.

Paths lead to few of the keys there are: plans are valued by the sets of those alone. So a policy is a table of these
plans and a rule for all other keys.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import among, block_rows, row_index, with_data
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.policies.table import PolicyTable, SetTable
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.task import Task
from trackmdp.solvers.linear import solve_onward
from trackmdp.solvers.mass import Passed
from trackmdp.solvers.renewal import Act, Renewal
from trackmdp.solvers.walk import all_events


@dataclass(frozen=True)
class AlongPaths:
    """A policy followed along all paths.

    Attributes:
        paths: the paths.
        acts: reports and prices of the policy.
        steps: what it does in each step.
        visits: `[B]`, how often the policy comes to each event on its path.
        reward: of all paths together, undiscounted.
    """

    paths: Paths
    acts: list[Act]
    steps: list[Passed]
    visits: Array
    reward: float

    # Of policies that are tried only the reward is asked for.
    @cached_property
    def value(self) -> Array:
        """`[B]` V, discounted, times γ."""
        located = sum((step.located for step in self.steps[1:]), self.steps[0].located)
        earned = np.sum([step.totals[:, 0] for step in self.steps], axis=0)
        return solve_onward(self.paths.places, located, earned)

    @cached_property
    def gain(self) -> list[Array]:
        """For each n `[E]`, worth of a report at each entry over a miss, discounted."""
        renewal, value, gains = self.paths.renewal, self.value, list[Array]()
        later = renewal.missed(value)
        for (report, spent), step in reversed(list(zip(self.acts, renewal.free, strict=True))):
            detected = renewal.task.reward + value[step.following]
            gains.insert(0, detected - later)
            gross = step.moves @ (report * detected + (1.0 - report) * later)
            later = gross - spent[step.before] * step.stay
        return gains


_SAMPLE = 100
"""Tracks by which the events of all of them are reckoned."""


class Paths:
    """All events (point, key) of some paths, and their steps.

    Args:
        task: sensors, prices, limits and memory.
        tracks: the paths; equal ones are followed once.
        discount: γ of the gains.

    Attributes:
        renewal: events and steps, moves discounted.
        times: `[B]`, how often the path of each event is among the tracks.
        copies: tracks for each that differs.
        moves: on all of the tracks.
        discount: γ.
        places: `[B]`, of the events in their paths.
    """

    def __init__(self, task: Task, tracks: Tracks, discount: float) -> None:
        self.task, self.discount = task, discount
        self.moves = len(tracks.cells) - len(tracks)
        tracks, times = different(tracks)
        self.renewal = Renewal(task, tracks.motion().discounted(discount))
        of_point = np.repeat(times, tracks.lengths).astype(np.float64)
        self.times = of_point[self.renewal.states]
        self.copies = float(times.mean())
        self.places = tracks.places[self.renewal.states]
        self._starts = np.bincount(self.renewal.first, minlength=self.renewal.count).astype(float)

    @property
    def keys(self) -> IndexArray:
        """`[K]`, the keys that some path may lead to."""
        return self.renewal.plans

    def follow(self, table: SetTable) -> AlongPaths:
        """A policy on all paths, its plans in the order of `keys`."""
        renewal, acts = self.renewal, list[Act]()
        owner, cell = renewal.owner, renewal.motion.cell
        for n, step in enumerate(renewal.free):
            report = table.reports(n, owner[step.rows], cell[step.states])
            acts.append((report, table.spent(n, self.task.paid)[owner]))
        steps = renewal.passes(acts)
        # Undiscounted: the moves before the end of step n carry γ^(n + 1), of a repeated safe action γ.
        factors = [np.full(renewal.count, self.discount ** -(n + 1)) for n in range(len(steps))]
        factors[-1][renewal.count - renewal.events.forced :] = factors[0][0]
        plain = sum(
            with_data(step.located, step.located.data * factor[row_index(step.located)])
            for step, factor in zip(steps, factors, strict=True)
        )
        visits = solve_onward(self.places, plain, self._starts, transposed=True)
        reward = sum(
            float(visits @ (self.times * factor * step.totals[:, 0]))
            for step, factor in zip(steps, factors, strict=True)
        )
        return AlongPaths(self, acts, steps, visits, reward)


def thinned(task: Task, tracks: Tracks, most: int, seed: int) -> Tracks:
    """Random ones of the tracks with about `most` events, equal ones together; all where there are no more.

    Where a safe action misses again and again, a point may follow from many before it.
    """
    groups = _groups(tracks)
    order = np.random.default_rng(seed).permutation(groups.max(initial=-1) + 1)
    each, _ = different(tracks)
    some = each.select(np.isin(np.arange(len(each)), order[:_SAMPLE]))
    events = len(all_events(task, task.keys, some.motion()).codes)
    share = most * len(some.cells) / (max(events, 1) * max(len(each.cells), 1))
    return (
        tracks if share >= 1 else tracks.select(np.isin(groups, order[: int(share * len(order))]))
    )


def different(tracks: Tracks) -> tuple[Tracks, IndexArray]:
    """The tracks that differ in where they lead, `[K]` of them, and how often each is there."""
    _, first, times = np.unique(_groups(tracks), return_index=True, return_counts=True)
    chosen: BoolArray = np.zeros(len(tracks), bool)
    chosen[first] = True
    return tracks.select(chosen), times


def _groups(tracks: Tracks) -> IndexArray:
    """`[K]`, one number for all tracks that lead to the same cells, in the order in which they first come."""
    number: dict[tuple[bytes, bool], int] = {}
    each = zip(tracks.pieces(), tracks.exits.tolist(), strict=True)
    return np.array([number.setdefault(piece, len(number)) for piece in each], np.int64)


@dataclass(frozen=True)
class KeyPlans:
    """A policy that does not draw, as plans of some keys and a rule for all others.

    Attributes:
        keys: `[K]` keys with plans, in order.
        table: their plans.
        others: from other keys `[Q]` to their sets, `[Q * (t_max + 1), S]` bool.
    """

    keys: IndexArray
    table: SetTable
    others: Callable[[IndexArray], sparse.csr_array]

    @classmethod
    def of_table(cls, policy: PolicyTable, keys: IndexArray) -> KeyPlans:
        """A policy with sets, `keys` apart."""
        task, sets = policy.task, policy.written

        def rows(keys: IndexArray) -> sparse.csr_array:
            return sets[block_rows(keys, task.num_choices)]

        return cls(keys, SetTable(task, rows(keys), len(keys)), rows)

    def on(self, keys: IndexArray) -> KeyPlans:
        """The same policy with plans of other `keys`, in their order."""
        task, (place, known) = self.table.task, among(self.keys, keys)
        own = self.table.sets[block_rows(place[known], task.num_choices)]
        both = sparse.vstack([own, self.others(keys[~known])], format="csr")
        # Rows of the known keys, then those of the others, are brought into the order of `keys`.
        order = np.argsort(~known, kind="stable").argsort()
        sets = both[block_rows(order, task.num_choices)]
        return KeyPlans(keys, SetTable(task, sets, len(keys)), self.others)

    def policy(self) -> PolicyTable:
        """The sets of all keys there are."""
        task = self.table.task
        return PolicyTable(task, self.on(np.arange(task.num_keys)).table.sets)


def along(paths: Paths, plans: KeyPlans) -> AlongPaths:
    """Plans followed on paths."""
    return paths.follow(plans.on(paths.keys).table)


def interleaved(sets: Sequence[sparse.csr_array]) -> sparse.csr_array:
    """The rows of a table of plans, from `[K, S]` for each n."""
    # Plan k after n misses is row k (t_max + 1) + n.
    order = np.arange(len(sets) * sets[0].shape[0]).reshape(len(sets), -1).T.ravel()
    return sparse.vstack(sets, format="csr")[order]
