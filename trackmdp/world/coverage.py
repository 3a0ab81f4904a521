"""Which cells each sensor covers, where that is not its own cell alone: sensors with a footprint.

A sensor that is on reports the target in any cell of its footprint, and its report names the cell. So what is sensed is
the union of the footprints of the sensors that are on, and a set of sensors takes the place of a set of cells: actions
and policies are over the S sensors, masses, values and what is seen over the M cells. The paper's sensors are the
identity, for which a task holds no `Coverage` at all.

On a line of four cells, two sensors that cover cells 0 1 2 and 2 3 are the matrix

    1 1 1 0
    0 0 1 1         cell 2 is seen if any of the two is on; both on cost both prices and see all four cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError


@dataclass(frozen=True, eq=False)
class Coverage:
    """The footprints of S sensors on a grid of M cells.

    Attributes:
        matrix: `[S, M]` canonical CSR of bool, the cells that each sensor covers.
    """

    matrix: sparse.csr_array

    @classmethod
    def of(cls, given: Any, cells: int) -> Coverage | None:
        """The footprints `given` as a `Coverage`, a table or a sparse matrix `[S, M]`; None for the paper's sensors.

        Raises:
            UserError: these are no footprints on a grid of `cells` cells.
        """
        if given is None:
            return None
        matrix = given.matrix if isinstance(given, Coverage) else _canonical(given)
        if len(matrix.shape) != 2 or matrix.shape[1] != cells or not matrix.shape[0]:
            shape = " x ".join(map(str, matrix.shape))
            raise UserError(f"coverage: a table of {shape}, expected a row per sensor, {cells} columns")
        empty = np.flatnonzero(np.diff(matrix.indptr) == 0)
        if len(empty):
            raise UserError(f"coverage: sensor {empty[0]} covers no cell, expected at least one")
        # Sensor s covers cell s alone: nothing is left to do for a coverage, and nothing may cost time or a bit.
        own = np.arange(cells)
        if matrix.shape == (cells, cells) and matrix.nnz == cells and np.array_equal(matrix.indices, own):
            return None
        return given if isinstance(given, Coverage) else cls(matrix)

    @property
    def num_sensors(self) -> int:
        """S."""
        return int(self.matrix.shape[0])

    @cached_property
    def by_cell(self) -> sparse.csr_array:
        """`[M, S]` bool, the sensors that cover each cell."""
        return sparse.csr_array(self.matrix.T.tocsr())

    @cached_property
    def degree(self) -> npt.NDArray[np.int64]:
        """`[M]`, how many sensors cover each cell; 0 where only the safe action locates the target."""
        return np.diff(self.by_cell.indptr).astype(np.int64)

    def as_lists(self) -> list[list[int]]:
        """The cells of each sensor."""
        return [part.tolist() for part in np.split(self.matrix.indices, self.matrix.indptr[1:-1])]

    def same_as(self, other: Coverage | None) -> bool:
        """Whether `other` are the same sensors."""
        return self is other or (
            other is not None and self.matrix.shape == other.matrix.shape and not (self.matrix != other.matrix).nnz
        )

    def cells(self, action: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """`[..., M]` bool, the cells that the sensors of `action` `[..., S]` cover together."""
        found: npt.NDArray[np.bool_] = (self.by_cell.astype(np.int32) @ action.reshape(-1, self.num_sensors).T).T > 0
        return found.reshape(*action.shape[:-1], -1)

    def seen(self, sets: sparse.csr_array) -> sparse.csr_array:
        """`[R, M]`, with what probability some of the sensors on covers each cell, of `sets` `[R, S]`.

        Bool sets give bool; probabilities, with which sensors are on independently of each other, 1 - Π (1 - p_s).
        """
        if sets.dtype == np.bool_:
            found = sparse.csr_array(sets.astype(np.int32) @ self.matrix.astype(np.int32)).astype(np.bool_)
        else:
            # 1 - Π (1 - p) = 1 - exp Σ log(1 - p); a sensor that is certainly on gives -inf, and so exactly 1.
            with np.errstate(divide="ignore"):
                logs = sparse.csr_array((np.log1p(-sets.data), sets.indices, sets.indptr), shape=sets.shape)
            found = sparse.csr_array(logs @ self.matrix.astype(np.float64))
            found.data = -np.expm1(found.data)
        found.sort_indices()
        return found

    def share(self, probability: float, k: int | None) -> npt.NDArray[np.float64]:
        """`[M]`, with what probability each cell is seen if every sensor is on with `probability`, or k of all are."""
        if k is None:
            return np.asarray(1.0 - (1.0 - probability) ** self.degree, dtype=np.float64)
        # None of the d sensors of a cell among k of S: Π_{i < d} (S - k - i) / (S - i), 0 once d > S - k.
        steps = np.arange(self.degree.max())
        none = np.cumprod(np.maximum(self.num_sensors - k - steps, 0) / (self.num_sensors - steps))
        return np.asarray(1.0 - np.concatenate([[1.0], none])[self.degree])


def discs(size: tuple[int, int], positions: npt.NDArray[np.int64], radius: float) -> sparse.csr_array:
    """`[S, M]` bool, the cells whose centres lie within `radius` cells of each sensor's.

    Args:
        size: (rows, columns) of the grid.
        positions: `[S, 2]` row and column of each sensor.
        radius: in cells; 0 is the sensor's own cell, 2 a disc of 13 cells.
    """
    rows, columns = size
    radius = min(radius, rows + columns)  # a larger one sees no more of the grid, and its square may be no number
    far = int(min(radius, max(rows, columns)))
    reach = np.arange(-far, far + 1)
    down, across = (each.ravel() for each in np.meshgrid(reach, reach, indexing="ij"))
    near = down**2 + across**2 <= radius**2
    # [S, offsets] each: every sensor's disc, and which of its cells lie in the grid.
    row, column = positions[:, :1] + down[near], positions[:, 1:] + across[near]
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    sensor = np.nonzero(inside)[0]
    place = (sensor, (row * columns + column)[inside])
    return sparse.csr_array((np.ones(len(sensor), dtype=bool), place), shape=(len(positions), rows * columns))


def _canonical(given: Any) -> sparse.csr_array:
    """A table of any kind as CSR of bool, sorted and without explicit zeros.

    Raises:
        UserError: its entries are not 0 or 1.
    """
    table = given if sparse.issparse(given) else np.asarray(given)
    if len(table.shape) != 2 or table.dtype.kind not in "biuf":
        raise UserError(f"coverage: {table.dtype} of shape {tuple(table.shape)}, expected a table of 0 and 1")
    matrix = sparse.csr_array(table)
    if matrix.dtype != np.bool_:
        matrix.sum_duplicates()
        if not np.isin(matrix.data, (0, 1)).all():
            raise UserError(
                "coverage: expected 0 and 1; within a footprint detection is certain, and a p_d below 1 is refused"
            )
        matrix = matrix.astype(np.bool_)
    matrix = sparse.csr_array(matrix, copy=True)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix
