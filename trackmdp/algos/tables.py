"""Reading from and adding up into tables over (cell, clock, sensor), as the losses of hindsight learning do."""

from __future__ import annotations

from torch import Tensor


def gather(table: Tensor, index: Tensor) -> Tensor:
    """`table.flatten()[index]`, the fastest way."""
    return table.reshape(-1).index_select(0, index.reshape(-1)).view(index.shape)


def scatter_add(values: Tensor, index: Tensor, length: int) -> Tensor:
    """`[length]`, the sums of the `values` that share an `index`."""
    return values.new_zeros(length).scatter_add_(0, index.reshape(-1), values.reshape(-1))
