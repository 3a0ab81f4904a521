"""A policy as plans of some keys and a rule for all others: there are more keys than a recording comes by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.path_gains import AlongPaths, Paths
from trackmdp.arrays.entries import among, block_rows
from trackmdp.arrays.types import IndexArray
from trackmdp.policies.table import PolicyTable, SetTable


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
