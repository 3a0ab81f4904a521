"""The sensors that can be chosen from a located cell: a square window around it or all of the grid.

Choices, memories and estimates per located cell are kept in the window's own numbering, so that they cost K numbers
and not M. With radius 1 on 6 columns, seen from cell 7 (row 1, column 1), the K = 9 sensors of the window are

    local   0 1 2        cell   0  1  2
            3 4 5               6  7  8
            6 7 8              12 13 14

and seen from cell 0 the local sensors 0, 1, 2, 3 and 6 lie outside the grid: nothing is there; switched on, they cost
and sense nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trackmdp.grid.displacements import cell_at
from trackmdp.grid.size import Size, grid_size
from trackmdp.sensing.task import Task


class Window(nn.Module):
    """Local and global numbers of the sensors around each located cell.

    Args:
        size: a task, or the grid's (rows, columns), one number for a square.
        radius: W; the window holds the cells up to W rows and columns away. None: all M cells, local = global.
        device: where the tables live.

    Attributes:
        radius: W, or None.
        width: K = (2W + 1)², or M without a radius.
    """

    _cells: Tensor | None

    def __init__(
        self, size: Task | Size, radius: int | None, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__()
        self.rows, self.columns = size.size if isinstance(size, Task) else grid_size(size)
        self.num_cells, self.radius = self.rows * self.columns, radius
        self.width = self.num_cells if radius is None else (2 * radius + 1) ** 2
        cell = torch.arange(self.num_cells, device=device)
        self._row = nn.Buffer(cell // self.columns, persistent=False)
        self._column = nn.Buffer(cell % self.columns, persistent=False)
        self.register_buffer("_cells", None, persistent=False)
        self._find_tables(device)

    def _find_tables(self, device: torch.device | str) -> None:
        """The tables that `find` and `inside` look up, for windows with a radius."""
        if self.radius is None:
            return
        radius, side, k = self.radius, 2 * self.radius + 1, self.width
        # Seen from x, cell y lies in line d = S·(row y - row x + W) + (column y - column x + W). With lines of length
        # S = columns + side no two places share a d: a column too far to the left ends up behind the side of the line
        # above, one too far to the right behind its own line's. Radius 1, 6 columns, S = 9: from 7 to 6 it is 9·1+0,
        # local 3; from 7 to 11 (4 to the right) 9·1+5, behind the side of 3: not in the window.
        line = self.columns + side
        place = torch.arange(side * line, device=device)
        local = torch.where(place % line < side, place // line * side + place % line, k)
        outside = torch.full((1,), k, device=device)
        self._slots = nn.Buffer(torch.cat([outside, local, outside]), persistent=False)
        code, exited = (
            line * self._row + self._column,
            4 * line * (self.rows + side),
        )  # which lies behind every line
        self._code = nn.Buffer(torch.cat([code, code.new_tensor([exited])]), persistent=False)
        # + 1: place 0 of the table stands for all that lies before it
        corner = code - radius * (line + 1) - 1
        # A path may go on from M once its target has exited: it has the place of cell 0; callers distinguish the two.
        self._corner = nn.Buffer(torch.cat([corner, corner[:1]]), persistent=False)
        groups = self.groups()
        first = torch.full((int(groups.max()) + 1,), self.num_cells, device=device)
        first.scatter_reduce_(0, groups, torch.arange(self.num_cells, device=device), "amin")
        self._groups = nn.Buffer(groups, persistent=False)
        self._inside = nn.Buffer(self.around(first) < self.num_cells, persistent=False)

    @classmethod
    def of(cls, task: Task, device: torch.device | str = "cpu") -> Window:
        """The sensors that can be chosen in `task` (`grid.window`)."""
        return cls(task, task.numbered, device)

    @classmethod
    def reaching(cls, size: Task | Size, radius: int, device: torch.device | str = "cpu") -> Window:
        """A window of that radius, or the whole grid where that has no more cells; holds all cells in reach."""
        rows, columns = size.size if isinstance(size, Task) else grid_size(size)
        return cls(
            (rows, columns), radius if (2 * radius + 1) ** 2 < rows * columns else None, device
        )

    @property
    def is_local(self) -> bool:
        """Whether a local number stands for a displacement, not for a cell."""
        return self.radius is not None

    @property
    def cells(self) -> Tensor:
        """`[M, K]` int64, the cell of each local sensor; M where it lies outside the grid."""
        if self._cells is None:
            self._cells = self.around(torch.arange(self.num_cells, device=self._row.device))
        return self._cells

    def around(self, start: Tensor) -> Tensor:
        """`[*B, K]` int64, the cells of the window of `start` `[*B]`; M where it lies outside the grid."""
        if self.radius is None:
            return torch.arange(self.num_cells, device=start.device).expand(
                *start.shape, self.num_cells
            )
        side = 2 * self.radius + 1
        step = torch.arange(side**2, device=start.device)
        row = (self._row[start] - self.radius).unsqueeze(-1) + step // side
        column = (self._column[start] - self.radius).unsqueeze(-1) + step % side
        cell, inside = cell_at((self.rows, self.columns), row, column)
        return torch.where(inside, cell, self.num_cells)

    def contains(self, start: Tensor, cell: Tensor) -> Tensor:
        """`[*B]` bool, whether `cell` `[*B]` is a cell of the window of `start` `[*B]`; never where it is M."""
        return self.find(start, cell) < self.width

    def find(self, start: Tensor, cell: Tensor) -> Tensor:
        """`[*L, B]` int64, the local number of `cell` `[*L, B]` seen from `start` `[B]`; at least K where it has none.

        `start` may have the shape of `cell`, too.
        """
        if self.radius is None:
            return cell
        place = _at(self._code, cell) - _at(self._corner, start)
        return _at(self._slots, place.clamp_(0, len(self._slots) - 1))

    def index(self, start: Tensor, cell: Tensor) -> Tensor:
        """As `find`; some number from 0 to K - 1 where the window does not hold the cell, as where it is M (exited)."""
        return self.find(start, cell).clamp_max(self.width - 1)

    def inside(self, start: Tensor) -> Tensor:
        """`[B, K]` bool, whether each local sensor seen from `start` `[B]` is a cell of the grid."""
        if self.radius is None:
            return torch.ones(len(start), self.width, dtype=torch.bool, device=start.device)
        return self._inside.index_select(0, self._groups.index_select(0, start))

    def to_global(self, start: Tensor, local: Tensor) -> Tensor:
        """`[*B, M]` over all cells, from `[*B, K]` over the window of `start` `[*B]`; zero elsewhere."""
        if self.radius is None:
            return local
        spread = local.new_zeros(*local.shape[:-1], self.num_cells + 1)
        # Column M takes the entries outside the grid and is cut off again.
        return spread.scatter_(-1, self.around(start), local)[..., : self.num_cells]

    def to_local(self, start: Tensor, everywhere: Tensor) -> Tensor:
        """`[*B, K]` over the window of `start` `[*B]`, from `[*B, M]` over all cells; zero outside the grid."""
        if self.radius is None:
            return everywhere
        around = self.around(start)
        inside = around < self.num_cells
        return everywhere.gather(-1, around.clamp_max(self.num_cells - 1)) * inside

    def groups(self, classes: Tensor | None = None) -> Tensor:
        """`[M]` int64 group of each cell: equal where the distances to the four borders agree up to the radius.

        With int64 `classes` `[M]` of the cells, also where each cell of the window is of the same class.
        """
        if classes is not None and (classes != classes[0]).any():
            known = torch.cat(
                [torch.unique(classes, return_inverse=True)[1], classes.new_tensor([-1])]
            )
            return torch.unique(known[self.cells], dim=0, return_inverse=True)[1]
        # Rows, and columns, of equal distances to their two borders: N numbers are sorted and not all M cells, which
        # learners that ask for a window in each batch would notice. Each row meets each column.
        rows, columns = (self._alike(side) for side in (self.rows, self.columns))
        return (rows[:, None] * (columns.max() + 1) + columns).ravel()

    def _alike(self, side: int) -> Tensor:
        """`[side]`, equal where the distances to both ends agree up to the radius."""
        place = torch.arange(side, device=self._row.device)
        margins = torch.stack([place, side - 1 - place], dim=1).clamp(max=self.radius)
        return torch.unique(margins, dim=0, return_inverse=True)[1]


def _at(table: Tensor, index: Tensor) -> Tensor:
    """`table` `[N]` at an `index` of any shape; for a batch of 4,096 `table[index]` takes three times as long."""
    # For the environment's batches, a row of numbers, reshaping would take as long as looking them up.
    return (
        table.index_select(0, index)
        if index.ndim == 1
        else _at(table, index.reshape(-1)).view(index.shape)
    )
