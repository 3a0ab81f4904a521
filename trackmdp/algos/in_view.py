"""The sensors that may see the target from a located cell on, and what each of them gains beside the others.

A set of sensors earns what it gains to see the target in each cell that it covers. With one sensor in each cell that
sum falls apart, and a cell's gain is its sensor's. With footprints sensors share cells: a sensor gains what none of the
others sees. Sets from which no change of one sensor gains are local optima of the weighted coverage
(`solvers/cover.py`). Where the others are on with probabilities, it gains the expectation of that, the slope of the
multilinear extension of coverage (Calinescu et al. 2011), whose maxima are sets.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor, nn
from torch.nn.functional import pad

from trackmdp.solvers.cover import Covering
from trackmdp.solvers.renewal import IndexArray, row_index
from trackmdp.world.model import Task
from trackmdp.world.windows import Window


class SensorsInView(nn.Module):
    """The sensors that cover cells of a window, from each located cell in numbers of their own.

    On a line of four cells two sensors cover the cells 0 1 2 and 2 3. Seen from cell 0, whose window of radius 1 has
    the cells (none, 0, 1), there is sensor 0 alone; seen from cell 2, with the cells 1 2 3, sensor 0 has the number 0
    and covers the first two, and sensor 1 has the number 1 and covers the last two.

    Args:
        task: its sensors.
        window: C cells around each located cell.

    Attributes:
        numbers: `[M, K]` int64, the sensors; S, which there is none of, where a located cell has fewer than K.
        width: K.
        shared: whether sensors have footprints; without, a window's cells are its sensors.
        entries: numbers that `seen` and `gains` gather for each set.
    """

    numbers: Tensor
    _of_cell: Tensor
    _of_sensor: Tensor

    def __init__(self, task: Task, window: Window) -> None:
        super().__init__()
        self.shared = task.coverage is not None
        tables = {"numbers": window.cells}
        if self.shared:
            device = window.cells.device
            tables = {name: torch.as_tensor(table, device=device) for name, table in _tables(task, window).items()}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)
        self.width = self.numbers.shape[1]
        self.entries = max((table[0].numel() for table in tables.values()), default=1)

    def seen(self, on: Tensor, rows: slice) -> Tensor:
        """`[R, T+1, C]` bool, which cells the sets `on` `[R, T+1, K]` of the located cells `rows` see."""
        return self._sums(on, self._of_cell[rows]) > 0 if self.shared else on

    def gains(self, gain: Tensor, on: Tensor, rows: slice) -> Tensor:
        """`[R, T+1, K]`, what each sensor gains more on than off beside the others.

        Args:
            gain: `[R, T+1, C]`, what it gains to see the target in each cell of the windows.
            on: `[R, T+1, K]`, with what probability each sensor is on, independently of the others; or bool.
            rows: located cells.
        """
        if not self.shared:
            return gain
        # A cell that no other sensor sees: Π (1 - p) over all of its sensors, less the sensor's own factor, which is
        # the same in all of its cells. Of p = 1 as much is left as a float tells from 1.
        off = torch.log1p(-on.float().clamp(max=1.0 - 2.0**-23))
        unseen = self._sums(off, self._of_cell[rows]).exp()
        return self._sums(gain * unseen, self._of_sensor[rows]) / off.exp()

    @staticmethod
    def _sums(values: Tensor, places: Tensor) -> Tensor:
        """`[R, T+1, A]`, sums of `values` `[R, T+1, B]` over `places` `[R, A, D]`, of which B stands for nothing."""
        index = places.flatten(1).unsqueeze(1).expand(-1, values.shape[1], -1)
        return pad(values, (0, 1)).gather(-1, index).view(*values.shape[:2], *places.shape[1:]).sum(-1)


def _tables(task: Task, window: Window) -> dict[str, IndexArray]:
    """`numbers`, the sensors of each cell `[M, C, D]`, and the cells of each sensor `[M, K, F]`, in local numbers."""
    cells = window.cells.cpu().numpy()
    rows, local = np.nonzero(cells < task.num_cells)
    covering = Covering.of(task, rows, cells[rows, local])
    assert covering is not None
    # Pairs of a located cell and a sensor are in order: those of 0 0 2 begin at 0 and 2, and have the numbers 0 1 0.
    number = np.arange(len(covering.rows)) - np.searchsorted(covering.rows, covering.rows)
    width = int(number.max(initial=0)) + 1
    numbers = np.full((task.num_cells, width), task.total_sensors)
    numbers[covering.rows, number] = covering.sensors
    by_cell = sparse.csr_array(covering.covers.T)
    return {
        "numbers": numbers,
        "_of_cell": _lists(by_cell, (rows, local), number, cells.shape, width),
        "_of_sensor": _lists(covering.covers, (covering.rows, number), local, numbers.shape, cells.shape[1]),
    }


def _lists(
    matrix: sparse.csr_array, place: tuple[IndexArray, IndexArray], names: IndexArray, shape: tuple[int, ...], none: int
) -> IndexArray:
    """`[*shape, D]`, at `place` the `names` of the columns of each row of `matrix`, filled up with `none`."""
    row = row_index(matrix)
    table = np.full((*shape, max(1, int(np.diff(matrix.indptr).max(initial=0)))), none)
    table[place[0][row], place[1][row], np.arange(len(row)) - matrix.indptr[row]] = names[matrix.indices]
    return table
