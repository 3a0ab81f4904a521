"""Motion kernels: each function returns one sub-stochastic sparse matrix, row i summing to 1 - p_exit(i).

The sampler of the environment is derived from the matrix (`environment/targets.py`); no law is written twice. Time and
memory follow the number of possible moves: a grid of 256 x 256 with five moves from each cell takes a second and 8 MB.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import ones_at, row_sums
from trackmdp.arrays.files import read_matrix
from trackmdp.arrays.types import Array, BoolArray, Indices
from trackmdp.grid.displacements import cell_at, window_offsets
from trackmdp.grid.size import Size, grid_size
from trackmdp.motion.kernel_checks import canonical_kernel

Border: TypeAlias = Literal["renormalize", "inside", "clip", "exit"]

_Offsets: TypeAlias = Indices

_CELLS_AT_ONCE = 2**15
"""Rows made together: rejected draws stay small beside the kernel."""


def random_support(
    size: Size,
    *,
    support_size: int,
    radius: int,
    low_probability: float,
    exit_probability: float,
    border: Border,
    seed: int,
) -> sparse.csr_array:
    """The paper's kernel (Section VII): from each cell, Z random positions of the (2·radius+1)² around it.

    One position has `low_probability`, the others share the rest equally; the target exits with `exit_probability`.
    With a single position left, that one has all of 1 - exit_probability.
    """
    grid, window, rng = grid_size(size), window_offsets(radius), np.random.default_rng(seed)
    lows = [
        _one_low(count, low_probability, exit_probability) for count in range(1, support_size + 1)
    ]
    weights = np.array([np.pad(low, (0, support_size - len(low))) for low in lows])
    # Row k - 1 of `weights` is for k positions left, padded with zeros to Z; totals[k - 1] is its sum, 1 - p_exit.
    totals = np.array([low.sum() for low in lows])
    blocks = []
    for cells in _blocks(grid):
        # Each row of `order` is one `rng.permutation` of the window, drawn in the order of the cells.
        order = rng.permuted(np.tile(np.arange(len(window)), (len(cells), 1)), axis=1)
        count = np.full(len(cells), support_size)
        if border == "inside":
            # Only positions in the grid count: they go first, in the order drawn.
            inside = _moved(grid, cells, window[order], clip=False)[1]
            order = np.take_along_axis(order, np.argsort(~inside, axis=1, kind="stable"), axis=1)
            count = np.minimum(inside.sum(axis=1), support_size)
        blocks.append(
            _place(
                grid,
                cells,
                window[order[:, :support_size]],
                weights[count - 1],
                totals[count - 1],
                border,
            )
        )
    return canonical_kernel(sparse.vstack(blocks))


def random_walk(
    size: Size, *, stay: float, diagonal: bool, exit_probability: float, border: Border
) -> sparse.csr_array:
    """A lazy random walk: stay with probability `stay`, else one of the 4 (or, with `diagonal`, 8) neighbours."""
    window = window_offsets(1)
    distance = np.abs(window).sum(axis=1)
    moves = (distance > 0) & ((distance == 1) | diagonal)
    weights = np.where(distance == 0, stay, (1.0 - stay) * moves / moves.sum())
    return _homogeneous(size, window, weights, exit_probability, border)


def drift(
    size: Size, *, direction: float, persistence: float, exit_probability: float, border: Border
) -> sparse.csr_array:
    """A target that heads one way: it keeps to `direction` (degrees, 0 = right, 90 = up) with `persistence`.

    With the rest of the probability it moves to any of the 9 cells around, uniformly. A direction between two of
    the eight neighbours is shared between them in proportion to the angle, so the mean heading is as asked. Row 0 is
    the top one, as in all pictures.
    """
    window = window_offsets(1)
    weights = np.full(len(window), (1.0 - persistence) / len(window))
    # 30 degrees is 2/3 of the way from right (0) to up-right (45): those get 1/3 and 2/3. Rows count downwards, so up
    # is -sin.
    eighth, share = divmod((direction % 360.0) / 45.0, 1.0)
    for step, part in ((int(eighth), 1.0 - share), (int(eighth) + 1, share)):
        angle = math.radians(45.0 * step)
        heading = (-round(math.sin(angle)), round(math.cos(angle)))
        weights[(window == heading).all(axis=1)] += persistence * part
    return _homogeneous(size, window, weights, exit_probability, border)


def load_table(
    size: Size,  # noqa: ARG001  (the file has its own size)
    *,
    path: str | Path,
    source: str = "kernel.path",
) -> sparse.csr_array:
    """Read a kernel from a .npy, .npz or .csv file, which messages name by `source`.

    An .npz holds one array, or one called `kernel`, or the arrays `data`, `indices`, `indptr` and `shape` of a CSR
    matrix, as `scipy.sparse.save_npz` writes them.

    Raises:
        UserError: there is no such file, or it holds no square table of numbers.
    """
    return canonical_kernel(read_matrix(source, path, name="kernel"), f"{source}={path}")


def _blocks(grid: tuple[int, int]) -> list[_Offsets]:
    """All cells in order, some at a time."""
    m = grid[0] * grid[1]
    return np.split(np.arange(m), range(_CELLS_AT_ONCE, m, _CELLS_AT_ONCE))


def _one_low(count: int, low: float, exit_probability: float) -> Array:
    """`[count]` probabilities: the first `low`, the others equal; all of it where there is only one."""
    if count == 1:
        return np.array([1.0 - exit_probability])
    # Z = 3, low = .1, p_exit = .05: .1, .425, .425.
    rest = (1.0 - low - exit_probability) / (count - 1)
    return np.array([low] + [rest] * (count - 1))


def _moved(
    grid: tuple[int, int], cells: Indices, offsets: _Offsets, *, clip: bool
) -> tuple[Indices, BoolArray]:
    """`[B, K]` the cells at `offsets` `[B, K, 2]` from `cells` `[B]`, and whether they are in the grid."""
    row, column = np.divmod(cells[:, None], grid[1])
    row, column = row + offsets[..., 0], column + offsets[..., 1]
    if clip:
        row, column = row.clip(0, grid[0] - 1), column.clip(0, grid[1] - 1)
    return cell_at(grid, row, column)


def _place(
    grid: tuple[int, int],
    cells: Indices,
    offsets: _Offsets,
    weights: Array,
    totals: Array,
    border: Border,
) -> sparse.csr_array:
    """`[B, M]` the kernel rows of `cells` `[B]`: `weights` `[B, K]` put at `offsets` `[B, K, 2]`.

    Positions outside are treated by the rule `border`; with `renormalize` and `inside` a row still sums to its entry of
    `totals` `[B]`, and where they leave no position at all the target stays.
    """
    target, inside = _moved(grid, cells, offsets, clip=border == "clip")
    # A weight of 0 makes no entry: the padding of rows with fewer positions, above all.
    inside &= weights != 0
    shape = len(cells), grid[0] * grid[1]
    # Entries of one place are added up in the order given, which SciPy's `sum_duplicates` may change.
    codes, place = np.unique(np.nonzero(inside)[0] * shape[1] + target[inside], return_inverse=True)
    total = np.bincount(place, weights[inside])
    rows = sparse.csr_array((total, np.divmod(codes, shape[1])), shape=shape)
    if border in ("renormalize", "inside"):
        empty = np.flatnonzero(np.diff(rows.indptr) == 0)
        stays = ones_at(empty, cells[empty], rows.shape, np.float64)
        rows = rows + stays
        # All of a row by one factor, so that the exit keeps its probability and the positions their proportions.
        rows.data *= np.repeat(totals / row_sums(rows), np.diff(rows.indptr))
    return rows


def _homogeneous(
    size: Size, window: _Offsets, weights: Array, exit_probability: float, border: Border
) -> sparse.csr_array:
    """The kernel with `weights` `[K]` in every row, at the offsets `window` `[K, 2]`."""
    grid, scaled = grid_size(size), weights * (1.0 - exit_probability)

    def rows(cells: Indices) -> sparse.csr_array:
        offsets = np.broadcast_to(window, (len(cells), *window.shape))
        same = np.broadcast_to(scaled, (len(cells), len(window)))
        return _place(grid, cells, offsets, same, np.full(len(cells), scaled.sum()), border)

    return canonical_kernel(sparse.vstack([rows(cells) for cells in _blocks(grid)]))
