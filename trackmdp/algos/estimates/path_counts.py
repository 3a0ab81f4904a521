"""Plans for keys, counted on paths: mean gains after each key, with back-off where little was seen.

The gains of sensors along the paths (`path_gains`) are averaged over the events with one key, and compared with their
prices. Means of seldom seen keys are drawn towards a prior mean: the mean of their class, which is the whole memory
but the cell, times the lift of their cell (`_Shared`). Means of a seldom seen class are drawn to those of coarser ones
(`KeySpace.contexts`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.path_gains import AlongPaths, Paths
from trackmdp.arrays.entries import among, block_rows, ones_at, per_row, summing
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.grid.displacements import apart, cell_at, displacement
from trackmdp.memory.keys import KeySpace
from trackmdp.policies.table import PolicyTable, SetTable
from trackmdp.sensing.decisions import sensing
from trackmdp.sensing.task import Task

_UNVISITED = 0.01
"""Weight of an event off the policy's own path: it shows the future after a rare key, but not as the policy itself
comes by the key."""
_KEYS_AT_ONCE = 16_384
_IN_VIEW = 0.999
"""Share of the displacements until the last free choice that are looked after; rare leaps are not."""
_LIFTED = 30.0
"""A cell's lift is drawn to 1 as if prior² / 30 more detections had been expected, and made; times the copies of each
path. Where cells have few detections, and large weights serve best, the moves on a few tracks would else count for all
keys of a cell: on storms that costs more than it gains, in a city it gains (chosen by validation tracks of both)."""
_LITTLE = 1e-9
"""Smallest prior weight, so that unseen keys fall back on their class even with `prior=0`."""


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


def interleaved(sets: Sequence[sparse.csr_array]) -> sparse.csr_array:
    """The rows of a table of plans, from `[K, S]` for each n."""
    # Plan k after n misses is row k (t_max + 1) + n.
    order = np.arange(len(sets) * sets[0].shape[0]).reshape(len(sets), -1).T.ravel()
    return sparse.vstack(sets, format="csr")[order]


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
        gains = [np.full(len(step.rows), paths.task.reward) for step in paths.renewal.steps[:-1]]
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
        self.cell = [cells[step.states] for step in renewal.steps[:-1]]
        self.plan = [renewal.owner[step.rows] for step in renewal.steps[:-1]]
        ends = [
            (start[step.rows], cell) for step, cell in zip(renewal.steps, self.cell, strict=False)
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
        self._shared: list[_Shared] = []
        sets: list[sparse.csr_array] = []
        above = self._above()
        for n, (step, gain) in enumerate(zip(renewal.steps, gains, strict=False)):
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
                    self._shared.append(_Shared.of(view, mean, own, arrived, prior))
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
        found: list[IndexArray] = [np.zeros(1, dtype=np.int64)]
        for (context, count), (higher, _) in zip(shared[1:], shared, strict=False):
            above = np.zeros(count, dtype=np.int64)
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

    def _expected(self, shared: _Shared, keys: IndexArray) -> sparse.csr_array:
        """`[Q, S]`, the sets after `keys` by their prior means alone."""
        view, task = self._view, self._view.paths.task
        classes = task.keys.num_classes
        known = keys % classes
        # Keys of one class at a time: few displacements are worth a sensor after it, from any cell.
        order = np.argsort(known.astype(np.min_scalar_type(classes)), kind="stable")
        ends = np.cumsum(np.bincount(known, minlength=classes))
        rows, columns = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
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


@dataclass(frozen=True)
class _Shared:
    """Prior mean gain of a key: the mean of its class times the lift of its cell.

    Were the cell and the class of a displacement independent given where the target goes, its chance would be that
    after the class, times the lift of the cell: chance from this cell over chance from anywhere; and divided by the sum
    of all such. Gains stand for chances here.

    Attributes:
        keys: how they are numbered.
        common: `[C, W]` (or `[1, W]`, where the cell alone is remembered) mean gains after each class.
        row: `[M]` of each cell in `lift`.
        lift: `[R, W]`, the last row for cells never seen, all 1.
        scale: `[R, C]`, so that the gains of all displacements together are lifted as those from the cell are.
    """

    keys: KeySpace
    common: Array
    row: IndexArray
    lift: Array
    scale: Array

    @classmethod
    def of(
        cls, view: _View, common: Array, own: sparse.csr_array, arrived: Array, prior: float
    ) -> _Shared:
        """By counts of the keys seen: gains `[K, W]` and arrivals."""
        task, seen = view.paths.task, view.paths.keys
        keys, row = task.keys, np.zeros(task.num_cells, dtype=np.int64)
        if keys.num_classes == 1:  # a key is its cell, and has the same counts
            return cls(keys, common, row, np.ones((1, view.width)), np.ones((1, 1)))
        cells, of_key = np.unique(keys.cell(seen), return_inverse=True)
        together = summing(of_key, len(cells))
        gains, weight = np.maximum((together @ own).toarray(), 0.0), together @ arrived
        # Poisson counts with a gamma prior on the lift (DuMouchel 1999): a rare displacement that was seen once is no
        # lift of a hundred, as it would be were chances smoothed before they are divided.
        prior = max(prior**2 / (_LIFTED * view.paths.copies), _LITTLE)
        chance = weight[:, None] * (gains.sum(0) / max(weight.sum(), 1e-12))
        lift = (gains + prior) / (chance + prior)
        common = np.maximum(common, 0.0)
        total = ((gains.sum(1) + prior) / (chance.sum(1) + prior))[:, None] * common.sum(1)
        product = lift @ common.T
        scale = np.divide(total, product, out=np.zeros_like(product), where=product > 0)
        row[:] = len(cells)
        row[cells] = np.arange(len(cells))
        lift, scale = (
            np.append(each, np.ones((1, each.shape[1])), axis=0) for each in (lift, scale)
        )
        return cls(keys, common, row, lift, scale)

    @property
    def most(self) -> Array:
        """`[C, W]`, no less than is expected from any cell."""
        return self.common * self.lift.max(0) * self.scale.max(0)[:, None]

    def after(self, keys: IndexArray, local: IndexArray) -> Array:
        """`[B, W]` gains of displacements `local` `[W]` after `keys` `[B]`."""
        # Each row of the lift once with each class: most cells are never seen, and all those have the last one.
        classes = self.keys.num_classes
        pairs = self.row[self.keys.cell(keys)] * classes + keys % classes
        pairs, place = np.unique(pairs, return_inverse=True)
        row, known = np.divmod(pairs, classes)
        gains = self.common[known[:, None], local] * self.lift[row[:, None], local]
        return (gains * self.scale[row, known][:, None])[place]


def along(paths: Paths, plans: KeyPlans) -> AlongPaths:
    """Plans followed on paths."""
    return paths.follow(plans.on(paths.keys).table)
