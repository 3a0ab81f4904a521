"""Which cells each sensor covers, where that is not its own cell alone: sensors with a footprint.

A sensor that is on reports the target in any cell of its footprint, and its report names the cell. The sensed cells are
the union of the footprints of the sensors that are on, and a set of sensors takes the place of a set of cells: actions
and policies are over the S sensors, masses and values over the M cells. The paper's sensors are the identity, for which
a task holds no `Coverage` at all.

An entry below 1 is the probability that the sensor reports a target there, independently of the others: a radar that
sees less far away.

On a line of four cells, two sensors that cover cells 0 1 2 and 2 3 are the matrix

    1 1 1 0
    0 0 1 1         cell 2 is seen if any of the two is on; both on cost both prices and see all four cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.entries import ones_at, row_index
from trackmdp.arrays.numbers import canonical
from trackmdp.errors import UserError
from trackmdp.grid.displacements import cell_at, window_offsets
from trackmdp.machine import check_free


@dataclass(frozen=True, eq=False)
class Coverage:
    """The footprints of S sensors on a grid of M cells.

    Attributes:
        matrix: `[S, M]` canonical CSR of float64 in (0, 1], the probability that each sensor that is on reports a
            target in each cell that it covers.
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
        matrix = (
            given.matrix
            if isinstance(given, Coverage)
            else canonical("coverage", given, "a table of 0 and 1")
        )
        if not ((matrix.data > 0) & (matrix.data <= 1)).all():
            raise UserError("coverage: expected 0 and 1, or probabilities of a report")
        if matrix.shape[1] != cells or not matrix.shape[0]:
            shape = " x ".join(map(str, matrix.shape))
            raise UserError(
                f"coverage: a table of {shape}, expected a row per sensor, {cells} columns"
            )
        empty = np.flatnonzero(np.diff(matrix.indptr) == 0)
        if len(empty):
            raise UserError(f"coverage: sensor {empty[0]} covers no cell, expected at least one")
        # Sensor s covers cell s alone: nothing is left to do for a coverage, and nothing may cost time or a bit.
        if matrix.shape[0] == cells and not (matrix != sparse.eye_array(cells, format="csr")).nnz:
            return None
        return given if isinstance(given, Coverage) else cls(matrix)

    @property
    def num_sensors(self) -> int:
        """S."""
        return int(self.matrix.shape[0])

    @cached_property
    def perfect(self) -> bool:
        """Whether each sensor reports every target in its cells."""
        return bool((self.matrix.data == 1.0).all())

    @cached_property
    def by_cell(self) -> sparse.csr_array:
        """`[M, S]`, the sensors that cover each cell."""
        return self.matrix.T.tocsr()

    @cached_property
    def mark(self) -> str | None:
        """A digest of the cells of each sensor; None where each covers the cell of its number, perhaps not surely."""
        parts = (self.matrix.indptr, self.matrix.indices)
        own = all(np.array_equal(part, np.arange(len(part))) for part in parts)
        if own and self.num_sensors == self.matrix.shape[1]:
            return None
        return sha256(b"".join(each.astype(np.int64).tobytes() for each in parts)).hexdigest()[:16]

    def as_lists(self) -> list[list[int]]:
        """The cells of each sensor."""
        return [part.tolist() for part in np.split(self.matrix.indices, self.matrix.indptr[1:-1])]

    def same_as(self, other: Coverage | None) -> bool:
        """Whether `other` are the same sensors."""
        return self is other or (
            other is not None
            and self.matrix.shape == other.matrix.shape
            and not (self.matrix != other.matrix).nnz
        )

    def cells(self, action: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """`[..., M]` bool, the cells that the sensors of `action` `[..., S]` cover together."""
        found: npt.NDArray[np.bool_] = (
            self.by_cell @ action.reshape(-1, self.num_sensors).T.astype(np.float64)
        ).T > 0
        return found.reshape(*action.shape[:-1], -1)


def reported(
    sets: sparse.csr_array, sees: sparse.csr_array, k: int | None = None
) -> sparse.csr_array:
    """`[R, M]` CSR, the probability 1 - Π (1 - p) that some sensor reports a target in each cell.

    Args:
        sets: `[R, S]`, probabilities of each sensor's being on, independently of each other.
        sees: `[S, M]`, probabilities that a sensor that is on reports a target.
        k: exactly so many sensors of each row are on, or all where it has fewer, each such subset as likely.
    """
    if k is not None:
        return _of_subsets(sets, sees, k)
    rows, each = row_index(sets), sees[sets.indices]
    place = row_index(each)
    # Of a set drawn with probabilities q, sensor s stays silent with 1 - q p; log Π = Σ log(1 - q p), and a sensor that
    # certainly reports gives -inf, and so exactly 1.
    with np.errstate(divide="ignore"):
        logs = np.log1p(-(sets.data[place] * each.data))
    shape = sets.shape[0], sees.shape[1]
    found = sparse.csr_array((logs, (rows[place], each.indices)), shape=shape)
    found.data = -np.expm1(found.data)
    return found


def _of_subsets(sets: sparse.csr_array, sees: sparse.csr_array, k: int) -> sparse.csr_array:
    """See `reported`: `_shared_out` for all rows with the same number of sensors at a time."""
    each, cells = sees[sets.indices], sees.shape[1]
    code = row_index(sets)[row_index(each)].astype(np.int64) * cells + each.indices
    # A row for each pair of a row of `sets` and a cell, with the sensors that cover it.
    pairs, pair = np.unique(code, return_inverse=True)
    covering = sparse.csr_array(
        (each.data, (pair, np.arange(len(code)))), shape=(len(pairs), len(code))
    )
    count, found = np.diff(sets.indptr)[pairs // cells], np.zeros(len(pairs))
    for sensors in np.unique(count).tolist():
        here = count == sensors
        found[here] = _shared_out(covering[here], min(k, sensors), sensors)
    return sparse.csr_array((found, np.divmod(pairs, cells)), shape=(sets.shape[0], cells))


def _shared_out(sees_by_cell: sparse.csr_array, k: int, sensors: int) -> npt.NDArray[np.float64]:
    """`[M]` probability of a report from each cell, where k of all sensors are on.

    Args:
        sees_by_cell: `[M, S]`, probabilities that a sensor that is on reports a target.
        k: exactly so many sensors are on, each such subset as likely.
        sensors: the existing ones.
    """
    degree = np.diff(sees_by_cell.indptr)
    shape = (len(degree), int(degree.max(initial=0)))
    filled = np.arange(shape[1]) < degree[:, None]
    p = np.zeros(shape)
    p[filled] = sees_by_cell.data
    # i of the d sensors of a cell are on with C(S - d, k - i) / C(S, k) for each such subset; all of it stay silent
    # with the sum over these subsets of Π (1 - p), the elementary symmetric polynomial e_i of 1 - p.
    silent = np.zeros((shape[0], shape[1] + 1))
    silent[:, 0] = 1.0
    for column in range(shape[1]):
        here = filled[:, column]
        silent[here, 1:] += silent[here, :-1] * (1.0 - p[here, column])[:, None]
    chance = np.array(
        [[_share(sensors, k, d, i) for i in range(shape[1] + 1)] for d in range(shape[1] + 1)]
    )
    return np.asarray(1.0 - (silent * chance[degree]).sum(axis=1))


def _share(sensors: int, k: int, d: int, i: int) -> float:
    """C(S - d, k - i) / C(S, k): the chance that, of d sensors, i given ones and no others are among k of S."""
    if i > d or not 0 <= k - i <= sensors - d:
        return 0.0
    on = math.prod((k - t) / (sensors - t) for t in range(i))
    return on * math.prod((sensors - k - t) / (sensors - i - t) for t in range(d - i))


def discs(
    size: tuple[int, int], positions: npt.NDArray[np.int64], radius: float
) -> sparse.csr_array:
    """`[S, M]` bool, the cells with centres within `radius` cells of each sensor's.

    Args:
        size: (rows, columns) of the grid.
        positions: `[S, 2]` row and column of each sensor.
        radius: in cells; 0 is the sensor's own cell, 2 a disc of 13 cells.
    """
    rows, columns = size
    radius = min(
        radius, rows + columns
    )  # a larger one sees no more of the grid, and its square may be no number
    far = int(min(radius, max(rows, columns)))
    down, across = window_offsets(far).T
    near = down**2 + across**2 <= radius**2
    # Measured: 30 bytes for each place of a disc, in the grid or not.
    check_free(f"sensor.radius={radius}", 30 * len(positions) * int(near.sum()))
    # [S, offsets] each: every sensor's disc, and which of its cells lie in the grid.
    cell, inside = cell_at(size, positions[:, :1] + down[near], positions[:, 1:] + across[near])
    return ones_at(np.nonzero(inside)[0], cell[inside], (len(positions), rows * columns))
