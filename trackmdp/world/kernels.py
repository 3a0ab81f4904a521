"""Motion kernels: each function returns one sub-stochastic table, row i summing to 1 - p_exit(i).

The sampler of the environment is derived from the table (`trackmdp.world.env`); no law is written twice.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.world.files import read_numbers
from trackmdp.world.model import Array

__all__ = ["Border", "random_support", "random_walk", "drift", "load_table", "check_homogeneous"]

Border: TypeAlias = Literal["renormalize", "inside", "clip", "exit"]


def random_support(
    size: int,
    *,
    support_size: int,
    radius: int,
    low_probability: float,
    exit_probability: float,
    border: Border,
    seed: int,
) -> Array:
    """The paper's kernel (Section VII): from each cell, Z random positions of the (2·radius+1)² around it.

    One position has `low_probability`, the others share the rest equally; the target exits with `exit_probability`.
    With a single position left, that one has all of 1 - exit_probability.
    """
    window = _window(radius)
    rng = np.random.default_rng(seed)
    table = np.zeros((size**2, size**2))
    for cell in range(size**2):
        order = rng.permutation(len(window))
        if border == "inside":
            order = order[_in_grid(size, cell, window[order])]
        chosen = window[order[:support_size]]
        table[cell] = _place(size, cell, chosen, _one_low(len(chosen), low_probability, exit_probability), border)
    return table


def random_walk(size: int, *, stay: float, diagonal: bool, exit_probability: float, border: Border) -> Array:
    """A lazy random walk: stay with probability `stay`, else one of the 4 (or, with `diagonal`, 8) neighbours."""
    window = _window(1)
    distance = np.abs(window).sum(axis=1)
    moves = (distance > 0) & ((distance == 1) | diagonal)
    weights = np.where(distance == 0, stay, (1.0 - stay) * moves / moves.sum())
    return _homogeneous(size, window, weights, exit_probability, border)


def drift(size: int, *, direction: float, persistence: float, exit_probability: float, border: Border) -> Array:
    """A target that heads one way: it keeps to `direction` (degrees, 0 = right, 90 = up) with `persistence`.

    With the rest of the probability it moves to any of the 9 cells around, uniformly. A direction between two of
    the eight neighbours is shared between them in proportion to the angle, so the mean heading is as asked. Row 0 is
    the top one, as in all pictures.
    """
    window = _window(1)
    weights = np.full(len(window), (1.0 - persistence) / len(window))
    eighth, share = divmod((direction % 360.0) / 45.0, 1.0)
    for step, part in ((int(eighth), 1.0 - share), (int(eighth) + 1, share)):
        angle = math.radians(45.0 * step)
        heading = (-round(math.sin(angle)), round(math.cos(angle)))
        weights[(window == heading).all(axis=1)] += persistence * part
    return _homogeneous(size, window, weights, exit_probability, border)


def load_table(size: int, *, path: str | Path) -> Array:  # noqa: ARG001  (a table has its own size, checked later)
    """Read a kernel table from a .npy, .npz (its only array, or the one called `kernel`) or .csv file."""
    return read_numbers("kernel.path", path, name="kernel")


def check_homogeneous(kernel: sparse.csr_array, size: int, source: str) -> None:
    """See that the target moves alike from all cells whose moves stay clear of the border.

    Raises:
        UserError: from two such cells it does not; `source` is named at the start of the message.
    """
    cell, (start, end) = np.arange(size**2), kernel.nonzero()
    row, column = cell // size, cell % size
    reach = max(np.abs(row[start] - row[end]).max(initial=0), np.abs(column[start] - column[end]).max(initial=0))
    inner = cell[(np.minimum(row, column) >= reach) & (np.maximum(row, column) < size - reach)]
    if not len(inner):
        return
    around = (np.arange(-reach, reach + 1)[:, None] * size + np.arange(-reach, reach + 1)).ravel()
    moves = np.asarray(kernel[inner[:, None], inner[:, None] + around].toarray())
    differs = np.abs(moves - moves[0]).max(axis=1) > 1e-9
    if differs.any():
        other = inner[np.flatnonzero(differs)[0]]
        raise UserError(
            f"{source}: kernel.homogeneous=true, but from cell {other} the target moves otherwise than from cell "
            f"{inner[0]}; expected alike away from the border"
        )


def _window(radius: int) -> np.ndarray:
    """`[(2·radius+1)², 2]` offsets (row, column), row by row."""
    steps = np.arange(-radius, radius + 1)
    return np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)


def _one_low(count: int, low: float, exit_probability: float) -> Array:
    """`[count]` probabilities: the first `low`, the others equal; all of it where there is only one."""
    if count == 1:
        return np.array([1.0 - exit_probability])
    rest = (1.0 - low - exit_probability) / (count - 1)
    return np.array([low] + [rest] * (count - 1))


def _in_grid(size: int, cell: int, offsets: np.ndarray) -> np.ndarray:
    position = np.array(divmod(cell, size)) + offsets
    return ((position >= 0) & (position < size)).all(axis=1)


def _place(size: int, cell: int, offsets: np.ndarray, weights: Array, border: Border) -> Array:
    """One kernel row: `weights` put at `offsets` around `cell`, what falls outside treated as `border` says.

    Where `renormalize` or `inside` leaves no position at all, the target stays.
    """
    row = np.zeros(size**2)
    position = np.array(divmod(cell, size)) + offsets
    if border == "clip":
        position = position.clip(0, size - 1)
    inside = ((position >= 0) & (position < size)).all(axis=1)
    cells = position[inside] @ (size, 1)
    np.add.at(row, cells, weights[inside])
    if border in ("renormalize", "inside"):
        if not row.any():
            row[cell] = 1.0
        row *= weights.sum() / row.sum()
    return row


def _homogeneous(size: int, window: np.ndarray, weights: Array, exit_probability: float, border: Border) -> Array:
    scaled = weights * (1.0 - exit_probability)
    return np.stack([_place(size, cell, window, scaled, border) for cell in range(size**2)])
