"""Networks over (last cell, steps since detection), which is what a deterministic policy of a Track-MDP depends on.

After a miss the next state is known in advance, so along a policy's own path the action history follows from these two:
the policy is a table of chains, one per located cell, and a net may be run on all of its rows at once.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

__all__ = ["CellClockNet", "Neighbourhood"]


class CellClockNet(nn.Module):
    """One hidden layer over embeddings of the cell, of the clock and of the pair, added up.

    Args:
        num_cells: M.
        num_clocks: values the clock takes, 0 ... num_clocks - 1.
        hidden: hidden units.
        outputs: numbers per row.
        bias: value of the outputs' bias at the start.
        generator: draws the initial weights, on its device.
        groups: int64 `[M]`, the group of each cell, numbered from 0; cells of one group share all weights. None: each
            cell is its own.
    """

    groups: Tensor | None

    def __init__(
        self,
        num_cells: int,
        num_clocks: int,
        *,
        hidden: int,
        outputs: int,
        bias: float,
        generator: torch.Generator,
        groups: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("groups", groups, persistent=False)
        if groups is not None:
            num_cells = int(groups.max()) + 1

        def normal(*shape: int, std: float) -> nn.Parameter:
            return nn.Parameter(std * torch.randn(shape, generator=generator, device=generator.device))

        self.cell = normal(num_cells, 1, hidden, std=0.3)
        self.clock = normal(num_clocks, hidden, std=0.3)
        self.pair = normal(num_cells, num_clocks, hidden, std=0.3)
        self.weight = normal(hidden, outputs, std=hidden**-0.5)
        self.bias = nn.Parameter(torch.full((outputs,), bias, device=generator.device))

    def forward(self, cells: slice = slice(None)) -> Tensor:
        """`[M, num_clocks, outputs]`, the outputs of every row, or of the rows of some `cells` alone."""
        embedding = self.cell + self.clock + self.pair
        if self.groups is None and cells != slice(None):
            embedding = embedding[cells]
        rows = embedding.relu() @ self.weight + self.bias
        return rows if self.groups is None else rows.index_select(0, self.groups[cells])


class Neighbourhood(nn.Module):
    """The cells a net's outputs stand for, as seen from a located cell: a square window around it.

    Seen from anywhere, an output stands for the same displacement. Where such a window has no fewer cells than the
    grid, output k stands for cell k.

    Args:
        size: N.
        radius: the target is never farther away than this, in rows and in columns.
        device: where the tables live.

    Attributes:
        width: K, the number of outputs.
        cells: `[M, K]`, the cell each output stands for; M where it lies outside the grid.
    """

    cells: Tensor
    _code: Tensor
    _center: Tensor

    def __init__(self, size: int, radius: int, device: torch.device) -> None:
        super().__init__()
        m, side = size**2, 2 * radius + 1
        self.radius, self.width = radius, min(side**2, m)
        cell = torch.arange(m, device=device)
        if self.width == m:
            cells, code, center = cell.expand(m, m), cell, torch.zeros_like(cell)
        else:
            row, column = cell // size, cell % size
            code = row * side + column
            center = code - radius * (side + 1)
            step = torch.arange(side**2, device=device)
            rows = row[:, None] + step // side - radius
            columns = column[:, None] + step % side - radius
            inside = (rows.clamp(0, size - 1) == rows) & (columns.clamp(0, size - 1) == columns)
            cells = torch.where(inside, rows * size + columns, m)
        self.register_buffer("cells", cells, persistent=False)
        # The output for cell y seen from x is code[y] - center[x].
        self.register_buffer("_code", torch.cat([code, code[:1]]), persistent=False)
        self.register_buffer("_center", center, persistent=False)

    @property
    def moves_along(self) -> bool:
        """Whether an output stands for a displacement, not for a cell."""
        return self.width < len(self.cells)

    def groups(self) -> Tensor:
        """`[M]` int64, the same number for cells from which the border looks alike within the radius."""
        size, cell = math.isqrt(len(self.cells)), torch.arange(len(self.cells), device=self.cells.device)
        row, column = cell // size, cell % size
        margins = torch.stack([row, size - 1 - row, column, size - 1 - column], dim=1).clamp(max=self.radius)
        return torch.unique(margins, dim=0, return_inverse=True)[1]

    def index(self, start: Tensor, cell: Tensor) -> Tensor:
        """`[*L, B]`, the output for `cell` `[*L, B]` seen from `start` `[B]`, int64; any where `cell` is M."""
        code = self._code.index_select(0, cell.reshape(-1)).view(cell.shape)
        # M has the code of cell 0, the lowest.
        return (code - self._center.index_select(0, start)).clamp_(min=0)

    def spread(self, on: Tensor) -> Tensor:
        """`[M, C, M]` bool over all cells, from `on` `[M, C, K]` over the outputs."""
        m, choices, _ = on.shape
        spread = on.new_zeros(m, choices, m + 1)
        spread.scatter_(2, self.cells[:, None].expand(-1, choices, -1), on)
        return spread[..., :m]
