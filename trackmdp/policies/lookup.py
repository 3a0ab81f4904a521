"""Rows of a sparse table for a batch of states, on any device."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.arrays.entries import row_index
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

DENSE = 2**24
"""Entries of a table up to which it is held dense, the faster way."""


def in_window(task: Task, sets: sparse.csr_array) -> sparse.csr_array:
    """`[R, K]`, the sets `[R, S]` of a policy in the local numbers of the window around each row's located cell."""
    if task.numbered is None:
        return sets
    start = torch.as_tensor(task.keys.cell(row_index(sets) // task.num_choices))
    # Local numbers are in the order of the cells they stand for, so that the columns of a row stay in order. A policy
    # of this task has no sensor outside the window, so that each has one below K.
    local = Window.of(task).find(start, torch.as_tensor(sets.indices, dtype=torch.int64)).numpy()
    return sparse.csr_array(
        (sets.data, local, sets.indptr), shape=(sets.shape[0], task.num_sensors)
    )


class Lookup:
    """Rows of a table for a batch of states: dense where it is small, else assembled from the stored entries.

    Args:
        table: `[R, M]` bool or float64.
        device: of the states.
    """

    def __init__(self, table: sparse.csr_array, device: torch.device) -> None:
        self.device, self._columns = device, table.shape[1]
        # Probabilities are compared with float32 draws, so they are held as such.
        stored = table if table.dtype == np.bool_ else table.astype(np.float32)
        small = table.shape[0] * table.shape[1] <= DENSE
        self._rows = torch.as_tensor(stored.toarray(), device=device) if small else stored

    def __call__(self, row: Tensor) -> Tensor:
        """`[*B, M]` of `row` `[*B]`: bool, or float32."""
        if isinstance(self._rows, Tensor):
            if len(self._rows) == 1:  # twice as fast
                return self._rows[0].expand(*row.shape, -1).clone()
            return self._rows[row]
        found = self._rows[row.reshape(-1).cpu().numpy()].toarray()
        return torch.as_tensor(found, device=self.device).reshape(*row.shape, self._columns)

    def entry(self, row: Tensor, column: Tensor) -> Tensor:
        """`[B]`, the entries at (`row`, `column`), both `[B]`."""
        if isinstance(self._rows, Tensor):
            return self._rows[row, column]
        # Copies: SciPy sets a flag of its indices, which arrays in torch's memory refuse.
        found = self._rows[row.cpu().numpy().copy(), column.cpu().numpy().copy()]
        return torch.as_tensor(found, device=self.device)
