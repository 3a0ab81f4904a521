"""Plans for keys, counted on recorded paths: what sensing gains after each key, with back-off where little was seen.

On a recorded path every policy can be replayed. At each point where it may locate the target, with each key that it may
then have (`Events`), the path tells what a sensor gains n misses later: r + V - W, V what the policy earns from a
detection there on, W what it earns where it misses, both on this very path. The mean gain of each sensor is compared
with its price. Means of seldom seen keys are drawn to those of what keys share (`KeySpace.contexts`): the cell is left
out first. There is no motion model, so nothing needs to be Markov in the key.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.recorded import Events
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.world.model import Array, BoolArray, Task
from trackmdp.world.tracks import Tracks

_UNVISITED = 0.01
"""Weight of a state that the policy does not get to on its path: it shows what follows a key that is rare, but not as
the policy itself comes by the key."""
_IN_VIEW = 0.999
"""Share of the displacements until the last free choice that are looked after; rare leaps are not."""
_CELLS_AT_ONCE = 2048


@dataclass(frozen=True)
class Planned:
    """The policy found, and what it earned on the paths that it was counted on.

    Attributes:
        policy: a set for every key and n.
        reward: of all paths together.
        seen: keys that some path may lead to.
        rounds: of policy iteration that raised the reward.
    """

    policy: PolicyTable
    reward: float
    seen: int
    rounds: int


def plan_keys(task: Task, tracks: Tracks, *, prior: float, discount: float, rounds: int) -> Planned:
    """Policy iteration on recorded paths; a round is kept only if it raises what the paths earn.

    Args:
        task: prices, limits and memory.
        tracks: the paths.
        prior: what a key shares counts as so many of its own detections.
        discount: γ of the credit.
        rounds: at most so many.
    """
    return plan_paths(Paths(task, tracks), prior=prior, discount=discount, rounds=rounds)


def plan_paths(paths: Paths, *, prior: float, discount: float, rounds: int) -> Planned:
    """See `plan_keys`."""
    task = paths.task
    # The first round is myopic: a detection is worth r, and nothing follows from it.
    gain = np.full((task.num_choices, paths.states), task.reward)
    best = _Counted(paths, gain, paths.times, prior)
    value = paths.follow(best.hits, best.spent, discount)
    kept = 0
    for _ in range(rounds):
        weight = np.where(value.visited, 1.0, _UNVISITED) * paths.times
        tried = _Counted(paths, value.gain, weight, prior)
        after = paths.follow(tried.hits, tried.spent, discount)
        if after.reward <= value.reward:
            break
        best, value, kept = tried, after, kept + 1
    return Planned(PolicyTable(task, best.table()), value.reward, len(paths.seen), kept)


@dataclass(frozen=True)
class AlongPaths:
    """A policy followed along all paths.

    Attributes:
        reward: earned, all paths together, undiscounted.
        visited: `[S]` whether the policy gets to the state.
        gain: `[T+1, S]`, what sensing the target at n misses is worth.
        value: `[S]` V.
    """

    reward: float
    visited: BoolArray
    gain: Array
    value: Array


class Paths:
    """All states (point, key) of the paths, and where the target is 1 ... t_max + 2 steps later.

    S states, T + 2 steps (`[T+2, S]` arrays), K displacements in view.

    Attributes:
        times: `[S]`, how often the state's path is among the tracks: those that are equal are worked on as one.
        copies: tracks for each that differs.
    """

    def __init__(self, task: Task, tracks: Tracks) -> None:
        self.task = task
        tracks, times = _different(tracks)
        events = Events.of(tracks, task.keys)
        at = np.flatnonzero(events.possible)
        self.states, self.key = len(at), events.key[at]
        number = np.zeros(len(events.point), dtype=np.int64)  # of a possible state among them
        number[at] = np.arange(self.states)
        point, cells, steps = events.point[at], events.line.cells, range(task.num_choices + 1)
        place = [np.minimum(point + n + 1, events.last[at]) for n in steps]
        self.cells = np.stack([cells[each] for each in place])
        # After a recording has stopped nothing is known, and after the exit nothing happens.
        known = np.stack([point + n + 1 <= events.last[at] for n in steps])
        self.inside: BoolArray = known & (self.cells < task.num_cells)
        follow = [np.where(self.inside[n], events.follow(at, n), 0) for n in steps]
        self.following = np.stack([number[each] for each in follow])
        self.first = number[events.first]
        self.times = np.repeat(times, np.diff(events.line.first))[point].astype(np.float64)
        self.copies = float(times.mean())
        self.seen, self.of_seen = np.unique(self.key, return_inverse=True)
        self._measure()

    def _measure(self) -> None:
        """Displacements from the located cell, as numbers in a square window; K, none, beyond it."""
        task, columns = self.task, self.task.columns
        start = task.keys.cell(self.key)
        rows, across = self.cells // columns - start // columns, self.cells % columns - start % columns
        far = np.maximum(np.abs(rows), np.abs(across))[:-1]
        seen = far[self.inside[:-1]]
        radius = int(np.ceil(np.quantile(seen, _IN_VIEW))) if len(seen) else 0
        self.radius = min(max(1, radius), self.task.rows + self.task.columns, task.window or 2**31)
        side = 2 * self.radius + 1
        self.width = side**2
        number = (rows[:-1] + self.radius) * side + across[:-1] + self.radius
        self.local = np.where(self.inside[:-1] & (far <= self.radius), number, self.width)

    @cached_property
    def price(self) -> Array:
        """`[T+1, S]` price of the sensor where the target is; infinite where it is out of view."""
        return np.where(self.local < self.width, np.append(self.task.cost, np.inf)[self.cells[:-1]], np.inf)

    def put_down(self, start: IndexArray, local: IndexArray) -> tuple[IndexArray, BoolArray]:
        """Cells of displacements `local` from cells `start`, and whether they are in the grid."""
        side = 2 * self.radius + 1
        row = start // self.task.columns + local // side - self.radius
        column = start % self.task.columns + local % side - self.radius
        inside = (row >= 0) & (row < self.task.rows) & (column >= 0) & (column < self.task.columns)
        return row * self.task.columns + column, inside

    def follow(self, hits: BoolArray, spent: Array, discount: float) -> AlongPaths:
        """What a policy earns on every path, given where its plans hit `[T+1, S]` and what they cost `[T+1, S]`."""
        task, last = self.task, self.task.num_choices
        # Backwards through a plan: what it earns until its detection, and which state that leads to (the state itself
        # with factor 0 where there is none), once from each n on.
        earned, factor = np.zeros((last + 1, self.states)), np.zeros((last + 1, self.states))
        onward = np.tile(np.arange(self.states), (last + 1, 1))
        plain = np.zeros(self.states)
        for n in range(last, -1, -1):
            stay = self.inside[n]
            found = stay & hits[n] if n < last else stay
            price = spent[n] if n < last else task.safe_cost
            follows = n < last
            later, factors, states = (
                (earned[n + 1], factor[n + 1], onward[n + 1]) if follows else (0.0, 0.0, onward[last])
            )
            earned[n] = stay * (np.where(found, task.reward, discount * later) - price)
            plain = stay * (np.where(found, task.reward, plain) - price)
            factor[n] = stay * np.where(found, discount, discount * factors)
            onward[n] = np.where(found, self.following[n], states)
        value = _totals(earned[0], factor[0], onward[0])
        visited = self._visited(onward[0], factor[0] > 0)
        missed = earned + factor * value[onward]  # [T+2, S], W_n
        gain = task.reward + discount * (value[self.following[:-1]] - missed[1:])
        return AlongPaths(float(plain[visited] @ self.times[visited]), visited, gain, value)

    def _visited(self, onward: IndexArray, goes_on: BoolArray) -> BoolArray:
        visited = np.zeros(self.states, dtype=bool)
        at: IndexArray = self.first
        while len(at):  # one step a detection, all paths at once
            visited[at] = True
            at = onward[at[goes_on[at]]]
        return visited


def _different(tracks: Tracks) -> tuple[Tracks, IndexArray]:
    """The tracks that differ in where they lead, `[K]` of them, and how often each is there."""
    number: dict[tuple[bytes, bool], int] = {}
    pieces = zip(np.split(tracks.cells, tracks.first[1:-1]), tracks.exits.tolist(), strict=True)
    each = [number.setdefault((cells.tobytes(), leaves), len(number)) for cells, leaves in pieces]
    _, first, times = np.unique(each, return_index=True, return_counts=True)
    chosen = np.zeros(len(tracks), dtype=bool)
    chosen[first] = True
    return tracks.select(chosen), times


def _totals(earned: Array, factor: Array, onward: IndexArray) -> Array:
    """`[S]` v = earned + factor · v[onward], along chains that end in factor 0: doubled until none goes on."""
    # After k rounds `earned` is that of 2^k detections, and `factor` what is left of what follows them.
    while factor.any():
        earned, factor, onward = earned + factor * earned[onward], factor * factor[onward], onward[onward]
    return earned


class _Counted:
    """Mean gains at every level of sharing, and the sets that follow from them.

    Attributes:
        hits: `[T+1, S]`, whether the plan of the state's key senses the target there.
        spent: `[T+1, S]`, what its set costs.
    """

    def __init__(self, paths: Paths, gain: Array, weight: Array, prior: float) -> None:
        self._paths, self._prior = paths, prior
        choices = paths.task.num_choices
        *shared, (key, _) = paths.task.keys.contexts(paths.key)
        del key
        # Every level follows sets of its own: what it counts at n is what its own sets have missed so far.
        alive = [np.ones(paths.states, dtype=bool) for _ in range(len(shared) + 1)]
        self.hits = np.zeros((choices, paths.states), dtype=bool)
        self.spent = np.zeros((choices, paths.states))
        self._common: list[Array] = []
        self._own: list[tuple[IndexArray, Array, Array]] = []
        above = self._above()
        for n in range(choices):
            mean = np.zeros((1, paths.width))
            for level, (context, count) in enumerate(shared):
                strength = 0.0 if level == 0 else prior
                own = self._sums(n, context, count, gain[n], weight * alive[level])
                mean = _mean(*own, strength, mean[above[level]])
                padded = np.append(mean, np.zeros((count, 1)), axis=1)
                alive[level] &= paths.inside[n] & ~(padded[context, paths.local[n]] > paths.price[n])
            self._common.append(mean)
            on = self._count_keys(n, gain[n], weight * alive[-1])
            seen = paths.of_seen
            found = np.zeros(paths.states, dtype=bool)
            near = paths.local[n] < paths.width
            found[near] = np.asarray(on[seen[near], paths.cells[n][near]]).ravel()
            self.hits[n] = found
            self.spent[n] = (on.astype(np.float64) @ paths.task.cost)[seen]
            alive[-1] &= paths.inside[n] & ~found

    def _above(self) -> list[IndexArray]:
        """For each shared level, the context above each of its contexts."""
        keys = self._paths.task.keys
        *shared, _ = keys.contexts(np.arange(keys.num_classes))  # the classes as keys of cell 0
        found: list[IndexArray] = [np.zeros(1, dtype=np.int64)]
        for (context, count), (higher, _) in zip(shared[1:], shared, strict=False):
            above = np.zeros(count, dtype=np.int64)
            above[context] = higher
            found.append(above)
        return found

    def _sums(self, n: int, context: IndexArray, count: int, gain: Array, weight: Array) -> tuple[Array, Array]:
        """`[count]` arrivals and `[count, K]` gains of the states in each context."""
        paths = self._paths
        weight = weight * paths.inside[n]
        arrived = per_row(context, weight, count)
        place = context * (paths.width + 1) + paths.local[n]
        gains = per_row(place, weight * gain, count * (paths.width + 1)).reshape(count, -1)
        return arrived, gains[:, :-1]

    def _count_keys(self, n: int, gain: Array, weight: Array) -> sparse.csr_array:
        """`[keys seen, M]` bool, the sets at n of the keys that were seen."""
        paths = self._paths
        weight = weight * paths.inside[n]
        arrived = per_row(paths.of_seen, weight, len(paths.seen))
        near = (paths.local[n] < paths.width) & (weight > 0)
        code = paths.of_seen[near] * paths.width + paths.local[n][near]
        codes, which = np.unique(code, return_inverse=True)
        gains = per_row(which, (weight * gain)[near], len(codes))
        self._own.append((codes, gains, arrived))
        return self._sets_of_seen(n)

    def _sets_of_seen(self, n: int) -> sparse.csr_array:
        paths, keys, common = self._paths, self._paths.task.keys, self._common[n]
        codes, gains, arrived = self._own[n]
        known = self._row(paths.seen % keys.num_classes)
        # Candidates are what was seen after the key, and what is sensed where the key's own count is nothing.
        row, local = np.nonzero(common > paths.task.cost.min())
        first = np.searchsorted(row, np.arange(len(common) + 1))
        count = np.diff(first)[known]
        start = np.repeat(first[known] - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
        more = np.repeat(np.arange(len(known)), count) * paths.width + local[start + np.arange(count.sum())]
        both = np.unique(np.concatenate([codes, more]))
        own = np.zeros(len(both))
        own[np.searchsorted(both, codes)] = gains
        seen, local = np.divmod(both, paths.width)
        value = (own + self._prior * common[known[seen], local]) / np.maximum(arrived[seen] + self._prior, 1e-12)
        cell, inside = paths.put_down(keys.cell(paths.seen[seen]), local)
        on = inside & (value > np.append(paths.task.cost, np.inf)[np.where(inside, cell, -1)])
        shape = (len(paths.seen), paths.task.num_cells)
        return sparse.csr_array((np.ones(int(on.sum()), dtype=bool), (seen[on], cell[on])), shape=shape)

    def _row(self, classes: IndexArray) -> IndexArray:
        """Rows of the finest shared table for keys of these classes."""
        return classes if len(self._common[0]) > 1 else classes * 0

    def table(self) -> sparse.csr_array:
        """`[keys (t_max + 1), M]`, the sets of all keys: by their own count, or where they were never seen without."""
        task, paths = self._paths.task, self._paths
        choices, indices, lengths = task.num_choices, [], np.zeros((task.num_keys, task.num_choices), dtype=np.int64)
        for n in range(choices):
            seen, own = self._sets_of_seen(n), np.zeros(task.num_keys, dtype=bool)
            seen.sort_indices()
            own[paths.seen] = True
            lengths[paths.seen, n] = np.diff(seen.indptr)
            key, cell = self._unseen(n, own)
            lengths[:, n] += np.bincount(key, minlength=task.num_keys)
            # Rows of either kind keep their order; where in all rows a row begins is known once all are counted.
            rows = np.concatenate([np.repeat(paths.seen, np.diff(seen.indptr)), key])
            order = np.argsort(rows, kind="stable")
            indices.append(np.concatenate([seen.indices, cell])[order])
        return _interleaved(indices, lengths, task.num_cells)

    def _unseen(self, n: int, seen: BoolArray) -> tuple[IndexArray, IndexArray]:
        """Keys and cells of the sets of all keys that were not seen, in order."""
        task, paths = self._paths.task, self._paths
        classes = task.keys.num_classes
        common = self._common[n]
        common = common if len(common) > 1 else np.repeat(common, classes, axis=0)
        known, local = np.nonzero(common > task.cost.min())
        value, found = common[known, local], []
        for begin in range(0, task.num_cells, _CELLS_AT_ONCE):
            start = np.arange(begin, min(begin + _CELLS_AT_ONCE, task.num_cells))[:, None]
            cell, inside = paths.put_down(start, local)
            key = start * classes + known
            on = inside & ~seen[key] & (value > task.cost[np.where(inside, cell, 0)])
            found.append((key[on], cell[on]))
        key, cell = (np.concatenate(part) for part in zip(*found, strict=True))
        return key, cell


def _mean(arrived: Array, gains: Array, strength: float, above: Array) -> Array:
    """`[C, K]` gains per arrival, `strength` arrivals of what is above added."""
    total = np.maximum(arrived + strength, 1e-12)
    mean: Array = (gains + strength * above) / total[:, None]
    return mean


def _interleaved(indices: list[IndexArray], lengths: IndexArray, cells: int) -> sparse.csr_array:
    """The rows of one table per n as rows key · (t_max + 1) + n of one table; `lengths` `[keys, t_max + 1]`."""
    pointer = np.concatenate([[0], np.cumsum(lengths.ravel())])
    merged = np.empty(pointer[-1], dtype=np.int32)
    choices = lengths.shape[1]
    for n, column in enumerate(indices):
        # Entry e of row k of table n goes to where row k · (t_max + 1) + n begins, plus its place in the row.
        own = lengths[:, n]
        begin = np.repeat(pointer[n:-1:choices] - (np.cumsum(own) - own), own)
        merged[begin + np.arange(len(column))] = column
    shape = (len(lengths) * choices, cells)
    return sparse.csr_array((np.ones(len(merged), dtype=bool), merged, pointer), shape=shape)
