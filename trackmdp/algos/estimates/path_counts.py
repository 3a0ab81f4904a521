"""Plans for keys, counted on paths: mean gains after each key, with back-off where little was seen.

The gains of sensors along the paths (`path_gains`) are averaged over the events with one key, and compared with their
prices. Means of seldom seen keys are drawn towards a prior mean: the mean of their class, which is the whole memory
but the cell, times the lift of their cell (`prior_means`). Means of a seldom seen class are drawn to those of coarser
ones (`KeySpace.contexts`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.path_gains import KeyPlans, Paths, along, interleaved
from trackmdp.algos.estimates.prior_means import PriorMeans
from trackmdp.arrays.entries import ones_at, per_row
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.grid.displacements import apart, cell_at, displacement
from trackmdp.policies.table import PolicyTable, SetTable
from trackmdp.sensing.decisions import sensing
from trackmdp.sensing.task import Task

_UNVISITED = 0.01
"""Weight of an event off the policy's own path: it shows the future after a rare key, but not as the policy itself
comes by the key."""
_KEYS_AT_ONCE = 16_384
_IN_VIEW = 0.999
"""Share of the displacements until the last free choice that are looked after; rare leaps are not."""


@dataclass(frozen=True)
class Planned:
    """Plans, and their reward on the paths that they were counted on.

    Attributes:
        plans: a set for every key and n.
        reward: of all paths together.
        paths: those.
    """

    plans: KeyPlans
    reward: float
    paths: Paths

    @cached_property
    def policy(self) -> PolicyTable:
        """The plans as a table of all keys."""
        return self.plans.policy()


def plan_paths(
    paths: Paths, *, prior: float, rounds: int, start: KeyPlans | None = None
) -> Planned:
    """Policy iteration on paths; a round is kept only if it raises their reward.

    Args:
        paths: followed with a discount.
        prior: weight of the prior mean of a key, in detections.
        rounds: at most so many.
        start: plans to begin with; None: myopic ones, a detection being worth r, and nothing following from it.
    """
    view = _View(paths)
    if start is None:
        gains = [np.full(len(step.rows), paths.task.reward) for step in paths.renewal.free]
        first = _Counted(view, gains, paths.times, prior)
        plans, value = first.plans, paths.follow(first.table)
    else:
        found = start
        plans, value = (lambda: found), along(paths, start)
    for _ in range(rounds):
        weight = np.where(value.visits > 0, value.visits, _UNVISITED) * paths.times
        tried = _Counted(view, value.gain, weight, prior)
        after = paths.follow(tried.table)
        if after.reward <= value.reward:
            break
        plans, value = tried.plans, after
    return Planned(plans(), value.reward, paths)


class _View:
    """Displacements from the located cell, as numbers in a square window; `width`, none, beyond it.

    Attributes:
        paths: the events.
        width: displacements in view.
        least: gain up to which no sensor pays.
        local: for each n `[E]` displacement of each entry, `width` out of view.
        cell: for each n `[E]` cell of each entry.
        plan: for each n `[E]` place of the key of each entry.
    """

    def __init__(self, paths: Paths) -> None:
        self.paths, renewal = paths, paths.renewal
        self._size = rows, columns = paths.task.size
        start = renewal.keys.cell(renewal.events.key)
        cells = renewal.motion.cell
        self.cell = [cells[step.states] for step in renewal.free]
        self.plan = [renewal.owner[step.rows] for step in renewal.free]
        ends = [
            (start[step.rows], cell) for step, cell in zip(renewal.free, self.cell, strict=True)
        ]
        far = [apart(columns, *pair) for pair in ends]
        seen = np.concatenate(far)
        radius = int(np.ceil(np.quantile(seen, _IN_VIEW))) if len(seen) else 0
        self.radius = min(max(1, radius), rows + columns, paths.task.window or 2**31)
        side = 2 * self.radius + 1
        self.width = side**2
        # With footprints many cells pay for one sensor.
        alone = paths.task.coverage is None
        self.least = float(paths.task.prices.min()) if alone else 0.0
        self.local = []
        for pair, away in zip(ends, far, strict=True):
            down, across = displacement(columns, *pair)
            number = (down + self.radius) * side + across + self.radius
            self.local.append(np.where(away <= self.radius, number, self.width))

    def reports(self, n: int, sets: sparse.csr_array) -> Array:
        """`[E]`, probability of a report at n by the sets `[K, S]` of the keys seen."""
        alone = Task(**self.paths.task.given | {"t_max": 0})  # one free choice: one set a key
        table = SetTable(alone, sets, len(self.paths.keys))
        return table.reports(0, self.plan[n], self.cell[n])

    def put_down(self, start: IndexArray, local: IndexArray) -> tuple[IndexArray, BoolArray]:
        """Cells of displacements `local` from cells `start`, and whether they are in the grid."""
        side, columns = 2 * self.radius + 1, self._size[1]
        row = start // columns + local // side - self.radius
        return cell_at(self._size, row, start % columns + local % side - self.radius)

    def sets(self, keys: IndexArray, gains: Array, wanted: IndexArray) -> sparse.csr_array:
        """`[Q, S]` bool, the best sets after `keys` `[Q]`, of `gains` `[Q, W]` at displacements `wanted` `[W]`."""
        task = self.paths.task
        row, place = np.nonzero(gains > self.least)
        located = task.keys.cell(keys)
        cell, inside = self.put_down(located[row], wanted[place])
        row, cell, gain = row[inside], cell[inside], gains[row, place][inside]
        order = np.lexsort((cell, row))
        choice = sensing(task, row[order], cell[order], len(keys), located)
        on = choice.best(gain[order, None], task.prices[choice.sensors, None])[:, 0]
        return ones_at(choice.rows[on], choice.sensors[on], (len(keys), task.total_sensors))


class _Counted:
    """Mean gains at every level of sharing, and the sets that follow from them."""

    def __init__(self, view: _View, gains: Sequence[Array], weight: Array, prior: float) -> None:
        self._view, self._prior = view, prior
        task, renewal = view.paths.task, view.paths.renewal
        *shared, _ = task.keys.contexts(renewal.plans)
        count = len(renewal.plans)
        # Every level follows sets of its own, the keys the last ones: its counts at n are of targets that its own sets
        # have missed so far. On a path each event has one entry at most.
        contexts = [*shared, (np.arange(count), count)]
        alive = [weight[: renewal.count] for _ in contexts]
        self._shared: list[PriorMeans] = []
        sets: list[sparse.csr_array] = []
        above = self._above()
        for n, (step, gain) in enumerate(zip(renewal.free, gains, strict=True)):
            mean = np.zeros((1, view.width))
            for level, (context, number) in enumerate(contexts):
                mass = alive[level][step.rows]
                own, arrived = self._sums(n, context, number, gain, mass)
                if level < len(shared):
                    # As many arrivals more of the level above; the first level has none above it.
                    more = prior * (level > 0)
                    total = np.maximum(arrived + more, 1e-12)
                    mean = (own.toarray() + more * mean[above[level]]) / total[:, None]
                    report = self._reports(n, context, mean)
                else:
                    self._shared.append(PriorMeans.of(view.paths, mean, own, arrived, prior))
                    sets.append(self._sets_of_seen(own, arrived))
                    report = view.reports(n, sets[-1])
                alive[level] = np.zeros(renewal.count)
                alive[level][step.rows] = mass * (1.0 - report)
        self.table = SetTable(task, interleaved(sets), count)

    def _reports(self, n: int, context: IndexArray, mean: Array) -> Array:
        """`[E]`, probability of a report by the sets of a level with mean gains `mean` `[C, W]`."""
        view, task = self._view, self._view.paths.task
        if task.coverage is None and task.budget is None:
            padded = np.append(mean, np.zeros((len(mean), 1)), axis=1)
            chance = task.detects(view.cell[n])
            gain = padded[context[view.plan[n]], view.local[n]]
            return np.where(gain * chance > task.prices[view.cell[n]], chance, 0.0)
        return view.reports(n, view.sets(view.paths.keys, mean[context], np.arange(view.width)))

    def _above(self) -> list[IndexArray]:
        """For each shared level, the context above each of its contexts."""
        keys = self._view.paths.task.keys
        *shared, _ = keys.contexts(np.arange(keys.num_classes))  # the classes as keys of cell 0
        found: list[IndexArray] = [np.zeros(1, np.int64)]
        for (context, count), (higher, _) in zip(shared[1:], shared, strict=False):
            above = np.zeros(count, np.int64)
            above[context] = higher
            found.append(above)
        return found

    def _sums(
        self, n: int, context: IndexArray, count: int, gain: Array, mass: Array
    ) -> tuple[sparse.csr_array, Array]:
        """`[count, W]` gains and `[count]` arrivals of the entries in each context of a key."""
        view = self._view
        group = context[view.plan[n]]
        near = (view.local[n] < view.width) & (mass > 0)
        place = (group[near], view.local[n][near])
        gains = sparse.csr_array(((mass * gain)[near], place), shape=(count, view.width))
        return gains, per_row(group, mass, count)

    def _sets_of_seen(self, own: sparse.csr_array, arrived: Array) -> sparse.csr_array:
        """`[K, S]` bool, the sets of the keys seen by their gains and arrivals and their prior means."""
        view, prior, known = self._view, self._prior, self._shared[-1]
        keys, parts = view.paths.keys, []
        # Most displacements are worth no sensor after any key at all.
        share = sparse.diags_array(1.0 / np.maximum(arrived + prior, 1e-12)) @ own
        most = share.max(axis=0).toarray().ravel() + known.most.max(0)
        wanted = np.flatnonzero(most > view.least)
        for begin in range(0, len(keys), _KEYS_AT_ONCE):
            each = slice(begin, begin + _KEYS_AT_ONCE)
            weight = prior / np.maximum(arrived[each] + prior, 1e-12)
            value = share[each][:, wanted].toarray()
            value = value + weight[:, None] * known.after(keys[each], wanted)
            parts.append(view.sets(keys[each], value, wanted))
        return sparse.vstack(parts, format="csr")

    def plans(self) -> KeyPlans:
        """The sets of all keys: by their own count, or by the prior mean alone."""
        return KeyPlans(self._view.paths.keys, self.table, self._unseen)

    def _unseen(self, keys: IndexArray) -> sparse.csr_array:
        """The sets after keys that were not seen."""
        return interleaved([self._expected(shared, keys) for shared in self._shared])

    def _expected(self, shared: PriorMeans, keys: IndexArray) -> sparse.csr_array:
        """`[Q, S]`, the sets after `keys` by their prior means alone."""
        view, task = self._view, self._view.paths.task
        classes = task.keys.num_classes
        known = keys % classes
        # Keys of one class at a time: few displacements are worth a sensor after it, from any cell.
        order = np.argsort(known.astype(np.min_scalar_type(classes)), kind="stable")
        ends = np.cumsum(np.bincount(known, minlength=classes))
        rows, columns = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for at, most in zip(np.split(order, ends[:-1]), shared.most, strict=True):
            wanted = np.flatnonzero(most > view.least)
            if not (len(at) and len(wanted)):
                continue
            value = shared.after(keys[at], wanted)
            on = view.sets(keys[at], value, wanted).tocoo()
            rows.append(at[on.row])
            columns.append(on.col)
        shape = (len(keys), task.total_sensors)
        return ones_at(np.concatenate(rows), np.concatenate(columns), shape)
