"""A network over (last cell, steps since detection), run on all of its rows at once.

That is the state that a deterministic policy depends on: after a miss the next state is known in advance, so along its
own path the action history follows from these two. The rows are a table of chains, one per located cell.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class CellClockNet(nn.Module):
    """One hidden layer over embeddings of the cell, of the clock and of the pair, added up; or a plain table.

    A hidden layer's decoder learns common patterns from all rows; a table of outputs has a number for each row
    and output, and takes a hundredth of the time.

    With `classes` a cell has as many rows, numbered cell · C + class as keys are (`KeySpace`). Then cell and class have
    each an embedding of their own with the clock, beside the key's: rare keys are known by these.

    Args:
        num_cells: M; with classes M · C.
        num_clocks: values the clock takes, 0 ... num_clocks - 1.
        hidden: hidden units; 0: a table.
        outputs: numbers per row.
        bias: value of the outputs' bias at the start.
        generator: draws the initial weights, on its device.
        groups: int64 `[M]`, the group of each cell, numbered from 0; cells of one group share all weights. None: each
            cell is its own.
        classes: C.
    """

    groups: Tensor | None

    def __init__(
        self,
        num_cells: int,
        num_clocks: int,
        *,
        hidden: int,
        outputs: int,
        generator: torch.Generator,
        bias: float = 0.0,
        groups: Tensor | None = None,
        classes: int = 1,
    ) -> None:
        super().__init__()
        self.register_buffer("groups", groups, persistent=False)
        if groups is not None:
            num_cells = int(groups.max()) + 1

        if not hidden:
            shape = (num_cells, num_clocks, outputs)
            self.table = nn.Parameter(torch.full(shape, bias, device=generator.device))
            return

        def normal(*shape: int, std: float) -> nn.Parameter:
            return nn.Parameter(
                std * torch.randn(shape, generator=generator, device=generator.device)
            )

        # [M, 1, H] + [C, H] + [M, C, H] broadcast to [M, C, H]: cell and clock share the common part, the pair
        # learns the rest.
        self.cell = normal(num_cells, 1, hidden, std=0.3)
        self.clock = normal(num_clocks, hidden, std=0.3)
        self.pair = normal(num_cells, num_clocks, hidden, std=0.3)
        # Std 1 / sqrt(H) keeps the outputs' size independent of the width.
        self.weight = normal(hidden, outputs, std=hidden**-0.5)
        self.bias = nn.Parameter(torch.full((outputs,), bias, device=generator.device))
        if classes > 1:
            self.located = normal(num_cells // classes, 1, num_clocks, hidden, std=0.3)
            self.known = normal(classes, num_clocks, hidden, std=0.3)

    def forward(self, cells: slice = slice(None)) -> Tensor:
        """`[M, num_clocks, outputs]`, the outputs of every row, or of the rows of some `cells` alone."""
        if hasattr(self, "table"):
            return self.table[cells] if self.groups is None else self.table[self.groups[cells]]
        embedding = self.cell + self.clock + self.pair
        if hasattr(self, "known"):
            embedding = embedding + (self.located + self.known).flatten(0, 1)
        # With groups the embedding has a row per group and not per cell; the wanted cells are picked at the end.
        if self.groups is None and cells != slice(None):
            embedding = embedding[cells]
        rows = embedding.relu() @ self.weight + self.bias
        return rows if self.groups is None else rows.index_select(0, self.groups[cells])
