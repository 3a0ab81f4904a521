"""Rows of a sparse table for a batch of states, on any device."""

from __future__ import annotations

import torch
from scipy import sparse
from torch import Tensor

from trackmdp.arrays.entries import row_index
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


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


class DenseTable:
    """All rows as a dense tensor: one indexing operation per batch, memory for every entry.

    Args:
        table: `[R, M]` bool or float64.
        device: where rows are looked up.
    """

    def __init__(self, table: sparse.csr_array, device: torch.device) -> None:
        self.device = device
        dense = torch.as_tensor(table.toarray(), device=device)
        # Probabilities are compared with float32 draws, so they are held as such.
        self._rows = dense if dense.dtype == torch.bool else dense.float()

    def __call__(self, row: Tensor) -> Tensor:
        """`[*B, M]` of `row` `[*B]`: bool, or float32."""
        return self._rows[row]

    def entry(self, row: Tensor, column: Tensor) -> Tensor:
        """`[*B]`, the entries at (`row`, `column`), both `[*B]`."""
        return self._rows[row, column]


class SparseTable:
    """Rows assembled from the stored entries; memory follows their number.

    Args:
        table: `[R, M]` bool or float64.
        device: where rows are looked up.
    """

    def __init__(self, table: sparse.csr_array, device: torch.device) -> None:
        self.device, self._columns = device, table.shape[1]
        self._begin = torch.as_tensor(table.indptr, dtype=torch.int64, device=device)
        self._index = torch.as_tensor(table.indices, dtype=torch.int64, device=device)
        data = torch.as_tensor(table.data, device=device)
        self._data = data if data.dtype == torch.bool else data.float()
        # The place of each entry if the rows were written end to end; in order, as the entries are.
        row = torch.repeat_interleave(self._begin.diff())
        self._place = row * self._columns + self._index

    def __call__(self, row: Tensor) -> Tensor:
        """`[*B, M]` of `row` `[*B]`: bool, or float32."""
        flat = row.reshape(-1)
        begin, length = self._begin[flat], self._begin[flat + 1] - self._begin[flat]
        # The entries of all rows of the batch, one row after another. Of rows with 2 and 3 entries that begin at 7 and
        # 20: batch = 0 0 1 1 1, before = 0 0 2 2 2, entry = 7 8 20 21 22.
        batch = torch.repeat_interleave(length)
        before = (length.cumsum(0) - length)[batch]
        entry = begin[batch] + torch.arange(len(batch), device=self.device) - before
        rows = torch.zeros(len(flat), self._columns, dtype=self._data.dtype, device=self.device)
        rows[batch, self._index[entry]] = self._data[entry]
        return rows.reshape(*row.shape, self._columns)

    def entry(self, row: Tensor, column: Tensor) -> Tensor:
        """`[*B]`, the entries at (`row`, `column`), both `[*B]`."""
        if not len(self._place):
            return torch.zeros(row.shape, dtype=self._data.dtype, device=self.device)
        # With M = 4: entry (3, 2) is place 3 * 4 + 2 = 14. Found at the first stored place that is no smaller, unless
        # that is another one; the clamp is for places beyond the last.
        wanted = row * self._columns + column
        found = torch.searchsorted(self._place, wanted).clamp_max(len(self._place) - 1)
        return self._data[found] * (self._place[found] == wanted)
