"""The ways on from rows (keys, or located cells) along paths, step by step, equal beginnings taken as one.

Example: from a row the target was twice in 4 then 5, once in 4 then 6, and once in 7: the first step has the entries 4
and 7 with probability 3/4 and 1/4, the second 5, 6 and 8 (for instance); 4 moves to 5 with 2/3.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.sensing.decisions import sensing
from trackmdp.sensing.task import Task
from trackmdp.solvers.plans import Turn


class Ways:
    """The steps made so far, as the free choices of plans.

    Args:
        task: its sensors and prices.
        located: `[K]`, the located cell of each row.
        entry: `[B]`, the row of each path.
        weight: `[B]`, of each path; 0 for those that are left out.
        discount: γ, which every move carries.

    Attributes:
        turns: the free choices.
        rows: `[E]`, the row of each entry after the last step; before any, the entries are the rows.
        mass: `[E]`, weight of all paths at each entry.
        entry: `[B]`, the entry of each path.
        weight: `[B]`, 0 for paths that have ended.
    """

    def __init__(
        self, task: Task, located: IndexArray, entry: IndexArray, weight: Array, discount: float
    ) -> None:
        self._task, self._located, self._discount = task, located, discount
        self.turns: list[Turn] = []
        self.rows, self.entry, self.weight = np.arange(len(located)), entry, weight
        self.mass = per_row(entry, weight, len(located))

    def moved(
        self, paths: IndexArray, ends: IndexArray, count: int
    ) -> tuple[sparse.csr_array, IndexArray]:
        """The `paths` move to `ends`, numbers below `count`; all others have ended.

        Returns:
            `[E_before, E]` the probability of each move, and `[E]` the end of each entry after it.
        """
        # Entries stay in order of their rows: a code begins with the entry before, and that with its row.
        codes, now = np.unique(self.entry[paths] * count + ends, return_inverse=True)
        before, end = np.divmod(codes, count)
        weight, entry = np.zeros_like(self.weight), np.zeros_like(self.entry)
        weight[paths], entry[paths] = self.weight[paths], now
        arrived = per_row(now, weight[paths], len(codes))
        chance = self._discount * arrived / self.mass[before]
        place, shape = (before, np.arange(len(codes))), (len(self.mass), len(codes))
        self.weight, self.entry, self.mass, self.rows = weight, entry, arrived, self.rows[before]
        return sparse.csr_array((chance, place), shape=shape), end

    def choose(self, moves: sparse.csr_array, cells: IndexArray) -> None:
        """The last move is followed by a free choice, the target then being in `cells` `[E]`."""
        choice = sensing(self._task, self.rows, cells, len(self._located), self._located)
        price = self._task.prices[choice.sensors]
        before = self.turns[-1].rows if self.turns else np.arange(len(self._located))
        self.turns.append(Turn(before, self.rows, moves, moves.sum(axis=1), choice, price))
