"""The size of a grid, and the memory that it needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from trackmdp.errors import UserError
from trackmdp.machine import check_free

Size: TypeAlias = int | Sequence[int]
"""Size of a grid as a user gives it: one number for a square, or rows and columns."""


def grid_size(size: Size) -> tuple[int, int]:
    """(rows, columns) of one number, or of two.

    Raises:
        UserError: these are no whole numbers of at least 1.
    """
    pair = tuple(size) if np.iterable(size) else (size, size)
    # np.integer is no int: a size may come out of an array's shape or of a file.
    if len(pair) != 2 or not all(
        isinstance(side, (int, np.integer)) and side >= 1 for side in pair
    ):
        raise UserError(f"size={size}: expected an integer >= 1, or two of them, rows and columns")
    return int(pair[0]), int(pair[1])


TASK_BYTES = 24
"""Bytes of each cell of any task: its price, p_d and p_s."""


def check_fits(key: str, size: Size, cell_bytes: int) -> None:
    """See that a grid fits into free memory; see `check_free`.

    Args:
        key: the option or argument, for messages.
        size: of the grid.
        cell_bytes: needed for each cell at the least.

    Raises:
        UserError: it does not fit.
    """
    check_free(f"{key}={size}", math.prod(grid_size(size)) * cell_bytes)
