"""Plans of all keys, worked out for those that are asked for: a table of 13 million keys takes a minute and 5 GB.

Recorded paths lead to few of the keys there are. What a plan earns on paths is found from the sets of their keys alone,
and the table of all keys is made of the plan that was chosen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.renewal import IndexArray
from trackmdp.world.model import Task

Sensed = tuple[IndexArray, IndexArray]
"""Sensors that are on: places in an array of keys, and cells, `[Q]` each."""


@dataclass(frozen=True)
class KeyPlans:
    """A policy that does not draw.

    Attributes:
        task: limits and memory.
        keys: `[K]` those whose sets are there, in order.
        sets: `[K, M]` bool, one for each n.
        others: what is on after n misses and any other keys.
    """

    task: Task
    keys: IndexArray
    sets: list[sparse.csr_array]
    others: Callable[[int, IndexArray], Sensed]

    @classmethod
    def of_table(cls, policy: PolicyTable, keys: IndexArray) -> KeyPlans:
        """A policy with sets, `keys` apart."""
        table, choices = policy.sets, policy.task.num_choices
        assert table is not None

        def rows(n: int, keys: IndexArray) -> sparse.csr_array:
            return sparse.csr_array(table[keys * choices + n])

        def others(n: int, keys: IndexArray) -> Sensed:
            return _entries(rows(n, keys))

        return cls(policy.task, keys, [rows(n, keys) for n in range(choices)], others)

    def of(self, keys: IndexArray) -> list[sparse.csr_array]:
        """`[len(keys), M]` bool, the sets of `keys`, for each n."""
        shape = (len(keys), self.task.num_cells)
        return [sensed_table(*each, shape) for each in self._sensed(keys)]

    def table(self) -> PolicyTable:
        """The sets of all keys there are."""
        return PolicyTable.from_sensed(self.task, self._sensed(np.arange(self.task.num_keys)))

    def _sensed(self, keys: IndexArray) -> list[Sensed]:
        place = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        known = self.keys[place] == keys
        mine, rest = np.flatnonzero(known), np.flatnonzero(~known)
        found = []
        for n, sets in enumerate(self.sets):
            (own, cells), (other, more) = _entries(sets[place[mine]]), self.others(n, keys[rest])
            found.append((np.concatenate([mine[own], rest[other]]), np.concatenate([cells, more])))
        return found


def sensed_table(rows: IndexArray, cells: IndexArray, shape: tuple[int, int]) -> sparse.csr_array:
    """`[K, M]` bool, with these entries."""
    return sparse.csr_array((np.ones(len(rows), dtype=bool), (rows, cells)), shape=shape)


def _entries(sets: sparse.csr_array) -> Sensed:
    listed = sets.tocoo()
    return listed.row.astype(np.int64), listed.col.astype(np.int64)
