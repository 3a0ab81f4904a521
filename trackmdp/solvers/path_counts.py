"""Plans for keys, counted on recorded paths: what sensing gains after each key, with back-off where little was seen.

What a sensor gains along the paths (`path_states`) is averaged over the states with one key, and compared with its
price. Means of seldom seen keys are drawn to what their class, all that is remembered but the cell, and their cell say
together (`_Shared`); those of a seldom seen class to coarser ones (`KeySpace.contexts`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.path_states import KeyPlans, Paths, SensorsOn, sensed_table
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.world.memory import KeySpace
from trackmdp.world.model import Array, Task
from trackmdp.world.tracks import Tracks

_UNVISITED = 0.01
"""Weight of a state that the policy does not get to on its path: it shows what follows a key that is rare, but not as
the policy itself comes by the key."""
_KEYS_AT_ONCE = 16_384
_LIFTED = 30.0
"""A cell's lift is drawn to 1 as if prior² / 30 more detections had been expected, and made; times the copies of each
path. Where cells have few detections, and large weights serve best, what its few tracks did would else be told of all
its keys: on storms that costs more than it gains, in a city it gains (chosen by validation tracks of both)."""
_LITTLE = 1e-9
"""Weight of what is shared where none is asked for: what was never seen is then still told by it."""


@dataclass(frozen=True)
class Planned:
    """The plans found, and what they earned on the paths that they were counted on.

    Attributes:
        plans: a set for every key and n.
        reward: of all paths together.
        seen: keys that some path may lead to.
        rounds: of policy iteration that raised the reward.
    """

    plans: KeyPlans
    reward: float
    seen: int
    rounds: int

    @cached_property
    def policy(self) -> PolicyTable:
        """The plans as a table of all keys."""
        return self.plans.table()


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
    return Planned(best.plans(), value.reward, len(paths.seen), kept)


class _Counted:
    """Mean gains at every level of sharing, and the sets that follow from them.

    Attributes:
        hits: `[T+1, S]`, whether the plan of the state's key senses the target there.
        spent: `[T+1, S]`, what its set costs.
    """

    def __init__(self, paths: Paths, gain: Array, weight: Array, prior: float) -> None:
        self._paths, self._prior = paths, prior
        choices = paths.task.num_choices
        *shared, _ = paths.task.keys.contexts(paths.key)
        # Every level follows sets of its own: what it counts at n is what its own sets have missed so far.
        alive = [np.ones(paths.states, dtype=bool) for _ in range(len(shared) + 1)]
        self.hits = np.zeros((choices, paths.states), dtype=bool)
        self.spent = np.zeros((choices, paths.states))
        self._shared: list[_Shared] = []
        self._sets: list[sparse.csr_array] = []  # `[keys seen, M]` bool each
        above = self._above()
        for n in range(choices):
            mean = np.zeros((1, paths.width))
            for level, (context, count) in enumerate(shared):
                strength = 0.0 if level == 0 else prior
                own, arrived = self._sums(n, context, count, gain[n], weight * alive[level])
                mean = _mean(own.toarray(), arrived, strength, mean[above[level]])
                padded = np.append(mean, np.zeros((count, 1)), axis=1)
                alive[level] &= paths.inside[n] & ~(padded[context, paths.local[n]] > paths.price[n])
            own, arrived = self._sums(n, paths.of_seen, len(paths.seen), gain[n], weight * alive[-1])
            self._shared.append(_Shared.of(paths, mean, own, arrived, prior))
            self._sets.append(on := self._sets_of_seen(own, arrived))
            self.hits[n], self.spent[n] = paths.sensed(n, on)
            alive[-1] &= paths.inside[n] & ~self.hits[n]

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

    def _sums(
        self, n: int, context: IndexArray, count: int, gain: Array, weight: Array
    ) -> tuple[sparse.csr_array, Array]:
        """`[count, K]` gains and `[count]` arrivals of the states in each context."""
        paths = self._paths
        weight = weight * paths.inside[n]
        near = (paths.local[n] < paths.width) & (weight > 0)
        place = (context[near], paths.local[n][near])
        gains = sparse.csr_array(((weight * gain)[near], place), shape=(count, paths.width))
        return gains, per_row(context, weight, count)

    def _sets_of_seen(self, own: sparse.csr_array, arrived: Array) -> sparse.csr_array:
        """`[keys seen, M]` bool, the sets of the keys seen by their gains and arrivals and what they share last."""
        paths, prior, known = self._paths, self._prior, self._shared[-1]
        cost, parts = np.append(paths.task.cost, np.inf), []
        # Most displacements are worth their price after no key at all.
        share = sparse.diags_array(1.0 / np.maximum(arrived + prior, 1e-12)) @ own
        most = share.max(axis=0).toarray().ravel() + known.most.max(0)
        wanted = np.flatnonzero(most > cost.min())
        for begin in range(0, len(paths.seen), _KEYS_AT_ONCE):
            each = slice(begin, begin + _KEYS_AT_ONCE)
            shared = prior / np.maximum(arrived[each] + prior, 1e-12)
            value = share[each][:, wanted].toarray() + shared[:, None] * known.after(paths.seen[each], wanted)
            key, place = np.nonzero(value > cost.min())
            local = wanted[place]
            cell, inside = paths.put_down(paths.task.keys.cell(paths.seen[begin + key]), local)
            on = inside & (value[key, place] > cost[np.where(inside, cell, -1)])
            parts.append((begin + key[on], cell[on]))
        key, cell = (np.concatenate(part) for part in zip(*parts, strict=True))
        return sensed_table(key, cell, (len(paths.seen), paths.task.num_cells))

    def plans(self) -> KeyPlans:
        """The sets of all keys: by their own count, or where they were never seen without."""
        return KeyPlans(self._paths.task, self._paths.seen, self._sets, self._unseen)

    def _unseen(self, n: int, keys: IndexArray) -> SensorsOn:
        """What is on after keys that were not seen."""
        cost, shared, classes = self._paths.task.cost, self._shared[n], self._paths.task.keys.num_classes
        start, known = np.divmod(keys, classes)
        # Keys of one class at a time: few displacements are worth a sensor after it, from whatever cell.
        order = np.argsort(known.astype(np.min_scalar_type(classes)), kind="stable")
        ends = np.cumsum(np.bincount(known, minlength=classes))
        found: list[SensorsOn] = [(np.zeros(0, dtype=np.int64),) * 2]
        for each, (high, most) in enumerate(zip(ends, shared.most, strict=True)):
            at = order[ends[each - 1] if each else 0 : high]
            wanted = np.flatnonzero(most > cost.min())
            if not (len(at) and len(wanted)):
                continue
            value = shared.of_class(each, start[at], wanted)
            place, local = np.nonzero(value > cost.min())
            cell, inside = self._paths.put_down(start[at[place]], wanted[local])
            on = inside & (value[place, local] > cost[np.where(inside, cell, 0)])
            found.append((at[place[on]], cell[on]))
        place, cell = (np.concatenate(part) for part in zip(*found, strict=True))
        return place, cell


@dataclass(frozen=True)
class _Shared:
    """What is expected after a key but for its own counts: mean gains of its class, as much more as from its cell.

    Were a displacement's cell and class independent given where the target goes, its chance would be that after the
    class, times the lift of the cell: chance from this cell over chance from anywhere; and divided by the sum of all
    such. Gains stand for chances here.

    Attributes:
        keys: how they are numbered.
        common: `[C, K]` (or `[1, K]`, where the cell alone is remembered) mean gains after each class.
        row: `[M]` of each cell in `lift`.
        lift: `[R, K]`, the last one that of cells never seen, all 1.
        scale: `[R, C]`, so that the gains of all displacements together are lifted as those from the cell are.
    """

    keys: KeySpace
    common: Array
    row: IndexArray
    lift: Array
    scale: Array

    @classmethod
    def of(cls, paths: Paths, common: Array, own: sparse.csr_array, arrived: Array, prior: float) -> _Shared:
        """By counts of the keys seen: gains `[keys seen, K]` and arrivals."""
        keys = paths.task.keys
        row = np.zeros(paths.task.num_cells, dtype=np.int64)
        if keys.num_classes == 1:  # a key is its cell, and has the same counts
            return cls(keys, common, row, np.ones((1, paths.width)), np.ones((1, 1)))
        cells, of_key = np.unique(keys.cell(paths.seen), return_inverse=True)
        summing = sparse.csr_array((np.ones(len(of_key)), (of_key, np.arange(len(of_key)))))
        gains, weight = np.maximum((summing @ own).toarray(), 0.0), summing @ arrived
        # Poisson counts with a gamma prior on the lift (DuMouchel 1999): a rare displacement that was seen once is no
        # lift of a hundred, as it would be were chances smoothed before they are divided.
        prior = max(prior**2 / (_LIFTED * paths.copies), _LITTLE)
        chance = weight[:, None] * (gains.sum(0) / max(weight.sum(), 1e-12))
        lift = (gains + prior) / (chance + prior)
        common = np.maximum(common, 0.0)
        total = ((gains.sum(1) + prior) / (chance.sum(1) + prior))[:, None] * common.sum(1)
        product = lift @ common.T
        scale = np.divide(total, product, out=np.zeros_like(product), where=product > 0)
        row[:] = len(cells)
        row[cells] = np.arange(len(cells))
        ones = [np.ones((1, each.shape[1])) for each in (lift, scale)]
        return cls(keys, common, row, np.append(lift, ones[0], axis=0), np.append(scale, ones[1], axis=0))

    @property
    def most(self) -> Array:
        """`[C, K]`, no less than is expected from any cell."""
        return self.common * self.lift.max(0) * self.scale.max(0)[:, None]

    def after(self, keys: IndexArray, local: IndexArray) -> Array:
        """`[B, W]` gains of displacements `local` `[W]` after `keys` `[B]`."""
        row, known = self.row[self.keys.cell(keys)], keys % self.keys.num_classes
        return self.common[known[:, None], local] * self.lift[row[:, None], local] * self.scale[row, known][:, None]

    def of_class(self, known: int, start: IndexArray, local: IndexArray) -> Array:
        """`[B, W]` gains of displacements `local` `[W]` after the class `known` and cells `start` `[B]`."""
        # Each row of the lift once: most cells are never seen, and all those have the last one.
        row, place = np.unique(self.row[start], return_inverse=True)
        gains: Array = self.common[known, local] * self.lift[np.ix_(row, local)] * self.scale[row, known][:, None]
        return gains[place]


def _mean(gains: Array, arrived: Array, strength: float, above: Array) -> Array:
    """`[C, K]` gains per arrival, `strength` arrivals of what is above added."""
    total = np.maximum(arrived + strength, 1e-12)
    return (gains + strength * above) / total[:, None]
