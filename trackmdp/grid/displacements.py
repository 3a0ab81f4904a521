"""Moves between cells in rows and columns; arrays or tensors of any shapes that go together."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def displacement(columns: int, start: Any, end: Any) -> tuple[Any, Any]:
    """Rows down and columns to the right from the cells `start` to the cells `end`, of a grid of so many columns."""
    return end // columns - start // columns, end % columns - start % columns


def window_offsets(radius: int) -> npt.NDArray[np.int64]:
    """`[(2·radius+1)², 2]` offsets (row, column) of a square window, row by row."""
    return np.indices((2 * radius + 1, 2 * radius + 1)).reshape(2, -1).T - radius


def apart(columns: int, start: npt.NDArray[Any], end: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """How far cells lie apart, in rows or in columns, whichever is more."""
    down, across = displacement(columns, start, end)
    return np.maximum(np.abs(down), np.abs(across))


def cell_at(size: tuple[int, int], row: Any, column: Any) -> tuple[Any, Any]:
    """The cells in rows and columns, and whether these are in the grid of this size; outside a cell has no meaning."""
    rows, columns = size
    # A column left of the first one would be at the end of the row above.
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return row * columns + column, inside
