"""The sensors that may see the target from a located cell on, and the gain of each beside the others.

A set of sensors earns the gain of a report in each cell that it covers. With one sensor in each cell that sum falls
apart, and a cell's gain is its sensor's. With footprints sensors share cells: a sensor gains the reports that none of
the others makes. Sets from which no change of one sensor gains are local optima of the weighted coverage
(`sensing/cover.py`). Where the others are on with probabilities, it gains the expectation of that, the slope of
the multilinear extension of coverage (Calinescu et al. 2011), with maxima at sets.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from torch import Tensor, nn
from torch.nn.functional import pad

from trackmdp.arrays.entries import padded_rows, ranks
from trackmdp.arrays.types import AnyArray, IndexArray
from trackmdp.sensing.cover import Shared
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

_CERTAIN = 1.0 - 2.0**-23
"""Stands for a probability of 1 where its logarithm is needed."""


class SensorsInView(nn.Module):
    """The sensors that cover cells of a window, from each located cell in numbers of their own.

    On a line of four cells two sensors cover the cells 0 1 2 and 2 3. Seen from cell 0, with the window of radius 1 on
    the cells (none, 0, 1), there is sensor 0 alone; seen from cell 2, with the cells 1 2 3, sensor 0 has the number 0
    and covers the first two, and sensor 1 has the number 1 and covers the last two.

    Where a policy knows more at a detection than the cell, the rows M of its tables are keys.

    Args:
        task: its sensors.
        window: C cells around each located cell.

    Attributes:
        window: as given.
        numbers: `[M, K]` int64, the sensors; S, which there is none of, where a located cell has fewer than K.
        prices: `[M, K]` their prices, in units of r; 0 of S.
        width: K.
        shared: whether sensors have footprints; without, a window's cells are its sensors.
        entries: numbers that `reports` and `gains` gather for each set.
    """

    numbers: Tensor
    prices: Tensor
    _of_cell: Tensor
    _cell_chance: Tensor
    _of_sensor: Tensor
    _sensor_chance: Tensor

    def __init__(self, task: Task, window: Window) -> None:
        super().__init__()
        self.window, self.shared = window, task.coverage is not None
        self._perfect = task.perfect and (self.shared or bool(task.available.all()))
        device, classes = window.cells.device, task.keys.num_classes
        tables = _tables(task, window) if self.shared else _own(task, window)
        # A sensor that does not exist reports nothing, and is learned to be off by a price like the others'. The last
        # one costs nothing, so that windows cut off by the border need no mask.
        price = np.where(task.available, task.cost, np.nanmean(task.cost)) / task.reward
        tables["prices"] = np.append(price, 0.0).astype(np.float32)[tables["numbers"]]
        for name, table in tables.items():
            rows = torch.as_tensor(table, device=device).repeat_interleave(classes, dim=0)
            self.register_buffer(name, rows, persistent=False)
        self.width = self.numbers.shape[1]
        self.entries = max((table[0].size for table in tables.values()), default=1)

    def reports(self, on: Tensor, rows: slice) -> Tensor:
        """`[R, T+1, C]` probability that sets `on` `[R, T+1, K]` report each cell; bool if no sensor misses."""
        if not self.shared:
            return on if self._perfect else on * self._cell_chance[rows].unsqueeze(1)
        if self._perfect:
            return self._gathered(on, self._of_cell[rows]).sum(-1) > 0
        return -torch.expm1(self._silent(on, rows).sum(-1))

    def gains(self, gain: Tensor, on: Tensor, rows: slice) -> Tensor:
        """`[R, T+1, K]`, the gain of each sensor on over off, beside the others.

        Args:
            gain: `[R, T+1, C]`, of a report in each cell of the windows.
            on: `[R, T+1, K]`, the probability that each sensor is on, independently of the others; or bool.
            rows: located cells.
        """
        if not self.shared:
            return gain if self._perfect else gain * self._cell_chance[rows].unsqueeze(1)
        # No other sensor reports a cell: the product of 1 - p over all of its sensors, less the sensor's own factor.
        unreported = self._silent(on, rows).sum(-1)
        of_sensor, chance = self._of_sensor[rows], self._sensor_chance[rows].unsqueeze(1)
        own = torch.log1p(-(on.float().unsqueeze(-1) * chance).clamp(max=_CERTAIN))
        others = (self._gathered(unreported, of_sensor) - own).exp()
        return (self._gathered(gain, of_sensor) * chance * others).sum(-1)

    def _silent(self, on: Tensor, rows: slice) -> Tensor:
        """`[R, T+1, C, D]` log(1 - p) of each sensor that covers a cell."""
        chance = self._gathered(on.float(), self._of_cell[rows])
        # Of p = 1 as much is left as a float differs from 1.
        return torch.log1p(-(chance * self._cell_chance[rows].unsqueeze(1)).clamp(max=_CERTAIN))

    @staticmethod
    def _gathered(values: Tensor, places: Tensor) -> Tensor:
        """`[R, T+1, A, D]`, `values` `[R, T+1, B]` at `places` `[R, A, D]`, of which B stands for nothing."""
        index = places.flatten(1).unsqueeze(1).expand(-1, values.shape[1], -1)
        return pad(values, (0, 1)).gather(-1, index).view(*values.shape[:2], *places.shape[1:])


def _own(task: Task, window: Window) -> dict[str, AnyArray]:
    """`numbers`, the cells of each window, and where sensors miss or are missing their p_d; 0 outside the grid."""
    cells = window.cells.cpu().numpy()
    chance = np.append(task.detection * task.available, 0.0).astype(np.float32)
    return {"numbers": cells} | (
        {} if (chance[:-1] == 1.0).all() else {"_cell_chance": chance[cells]}
    )


def _tables(task: Task, window: Window) -> dict[str, AnyArray]:
    """`numbers`; the sensors of each cell `[M, C, D]` and the cells of each sensor `[M, K, F]`, with their p_d."""
    cells = window.cells.cpu().numpy()
    rows, local = np.nonzero(cells < task.num_cells)
    covering = Shared.of(task, rows, cells[rows, local], task.num_cells, np.arange(task.num_cells))
    number = ranks(covering.rows)
    width = int(number.max(initial=0)) + 1
    numbers = np.full((task.num_cells, width), task.total_sensors)
    numbers[covering.rows, number] = covering.sensors
    by_cell, place = sparse.csr_array(covering.sees.T), (covering.rows, number)
    of_cell, cell_chance = _lists(by_cell, (rows, local), number, cells.shape, width)
    of_sensor, chance = _lists(covering.sees, place, local, numbers.shape, cells.shape[1])
    tables = {"numbers": numbers, "_of_cell": of_cell, "_cell_chance": cell_chance}
    return tables | {"_of_sensor": of_sensor, "_sensor_chance": chance}


def _lists(
    matrix: sparse.csr_array,
    place: tuple[IndexArray, IndexArray],
    names: IndexArray,
    shape: tuple[int, ...],
    none: int,
) -> tuple[IndexArray, npt.NDArray[np.float32]]:
    """`[*shape, D]`, at `place` the `names` of the columns of each row of `matrix`, filled up with `none`; its data."""
    columns, numbers = padded_rows(matrix, len(names))
    table = np.full((*shape, columns.shape[1]), none)
    data = np.zeros(table.shape, np.float32)
    table[place], data[place] = np.append(names, none)[columns], numbers
    return table, data
