"""Maps of policies: the sets sensed around each located cell, and the reward missing from each start cell.

On a large grid the number of sensors in place of the sets, and means over square tiles in place of cells.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.reports.results import Mapped
from trackmdp.reports.style import (
    BLUE,
    INK,
    PALE,
    TEXT,
    VERMILION,
    WIDTH,
    Axes,
    Canvas,
    Figure,
    draw_figure,
    grid_lines,
)
from trackmdp.reports.tables import Column, Rows, Table

# 20 x 20: with tiles of four to six cells each, more would not be seen on a page.
MOST_MAP_CELLS = 400
"""Cells of a grid up to which sets are drawn, one tile around each located cell."""
MOST_TILES = 60
"""Tiles of a map in each direction: a square of 3 pixels on a page."""
SHADES = 12
"""Shades of a map."""
_AFTER = ("just located (n = 0)", "after one miss (n = 1)")
_SIDE = 0.92
"""Side of a drawn cell: the gap shows the grid without lines."""

_Size: TypeAlias = tuple[int, int]
_Tiles: TypeAlias = dict[str, Array]
"""Numbers `[rows of tiles, columns of tiles]` by heading."""


def policy_map(name: str, drawn: Mapped) -> Figure:
    """Sensors that are on around each located cell, after no miss and after one.

    Where the first set leaves nothing out, a miss cannot happen, and nothing is drawn for it.
    """
    title = f"Sets sensed around each located cell, {drawn.label}"
    shown = range(min(drawn.choices, 2))
    if len(drawn.value) > MOST_MAP_CELLS:
        counts = {_AFTER[n]: binned(drawn.on(n).sum(axis=1), drawn.size) for n in shown}
        return _shaded(f"sets-{name}", f"Number of {title.lower()}", counts, drawn.size, "sensors")
    # `[n][M, M]`, row x: with the target last located in x.
    sets = [drawn.on(n).toarray() for n in range(drawn.choices)]
    possible = [mass.toarray() > 0 for mass in (drawn.kernel, drawn.after)]
    # A stored plan has a set for each n, also where that many misses cannot happen.
    sensed = [sets[n] * possible[n].any(axis=1, keepdims=True) for n in shown]
    # One size of tile for all, by the farthest cell drawn.
    reach = _reach(np.any([*possible, *(on > 0 for on in sensed)], axis=0), drawn.size)

    def paint(figure: Canvas) -> None:
        for axes, n in zip(np.atleast_1d(figure.subplots(len(shown), 1)), shown, strict=True):
            _draw_tiles(axes, sensed[n], possible[n], drawn.size, reach)
            axes.set_title(_AFTER[n])

    if drawn.averaged:
        title += (
            "; filled areas are shares of the detections in a cell, since plans differ by memory"
        )
    table = _table_of_sets(f"sets-{name}", title, drawn, sets, possible)
    return draw_figure(table, 0.4 + 3.9 * len(shown), paint)


def _table_of_sets(
    name: str, title: str, drawn: Mapped, sets: Sequence[Array], possible: Sequence[BoolArray]
) -> Table:
    """A row for each located cell and number of misses that can happen."""
    columns = drawn.size[1]
    rows: Rows = [
        [
            *(x, n, float(on[x].sum()), int(can[x].sum())),
            " ".join(f"{j // columns + 1}.{j % columns + 1}" for j in np.flatnonzero(on[x])),
        ]
        for x in range(len(drawn.value))
        for n, (on, can) in enumerate(zip(sets, possible, strict=False))
        if can[x].any()
    ]
    digits = 2 if drawn.averaged else 0
    heads = [Column("located in cell"), Column("misses n"), Column("cells sensed", digits)]
    heads += [Column("possible cells"), Column("which (row.column)")]
    return Table(name, title, heads, rows)


def missing(drawn: Sequence[Mapped]) -> _Tiles:
    """Per policy of one world, and for Q_MDP, the expected reward below the clocked bound by start cell.

    The clocked bound is the optimum wherever a policy attains it.
    """
    first = drawn[0]
    found = {each.method: first.bound - each.value for each in drawn}
    if np.isfinite(first.qmdp).all():
        found["Q_MDP"] = first.bound - first.qmdp
    # 1e-6: rounding errors of an optimal policy
    return {
        label: binned(np.where(values < 1e-6, 0.0, values), first.size)
        for label, values in found.items()
    }


def shades(every: Iterable[_Tiles]) -> Array:
    """Ends of the shades that all maps of a page share: quantiles of all values, so that each shade is as frequent.

    Values of good and poor policies differ by factors of a thousand; on an even scale each map has one shade.
    """
    values = np.concatenate([tiles.ravel() for each in every for tiles in each.values()])
    # Equal quantiles, as of a policy that is optimal in half of the cells, make one shade.
    ends = np.unique(np.quantile(values, np.linspace(0, 1, SHADES + 1)))
    return ends if len(ends) > 1 else np.array([0.0, max(1e-6, float(ends[0]))])


def missing_map(name: str, drawn: Sequence[Mapped], ends: Array) -> Figure:
    """`missing` side by side, in the shades between `ends`."""
    tiles, world = missing(drawn), drawn[0].world
    title = f"Expected reward missing to the best possible, by start cell, {world}"
    means = ", ".join(f"{label} {values.mean():.3g}" for label, values in tiles.items())
    seeds = ", ".join(f"{each.method} seed {each.seed}" for each in drawn)
    title += f"; mean: {means}; n = 1 run each ({seeds})"
    return _shaded(f"missing-{name}", title, tiles, drawn[0].size, "missing reward", ends)


def _shaded(
    name: str, title: str, tiles: _Tiles, size: _Size, label: str, ends: Array | None = None
) -> Figure:
    """Maps side by side in the same shades."""
    ends = shades([tiles]) if ends is None else ends

    def paint(figure: Canvas) -> None:
        from matplotlib import colormaps
        from matplotlib.colors import BoundaryNorm

        colours = colormaps["viridis_r"].resampled(len(ends) - 1)
        every = np.atleast_1d(figure.subplots(1, len(tiles)))
        for axes, head, values in zip(every, _heads(figure, tiles), tiles.values(), strict=True):
            mesh = axes.pcolormesh(values, cmap=colours, norm=BoundaryNorm(ends, len(ends) - 1))
            axes.invert_yaxis()  # row 1 on top, as in the numbering of cells
            axes.set(aspect="equal", xticks=[], yticks=[], title=head)
        bar = figure.colorbar(
            mesh, ax=list(every), orientation="horizontal", fraction=0.07, pad=0.03
        )
        some = ends[np.linspace(0, len(ends) - 1, min(4, len(ends))).astype(int)].tolist()
        bar.set_ticks(some, labels=[f"{float(f'{end:.2g}'):,g}" for end in some])
        bar.set_label(label)
        assert bar.solids is not None
        bar.solids.set_rasterized(False)  # a page loads no pictures

    side = _side(size)
    if side > 1:
        title += f"; means over tiles of {side} x {side} cells"
    # A row for each tile, by the row and column of its first cell.
    rows: Rows = [
        [side * i + 1, side * j + 1, *(float(values[i, j]) for values in tiles.values())]
        for i, j in np.ndindex(*next(iter(tiles.values())).shape)
    ]
    columns = [Column("row"), Column("column"), *(Column(label, 4) for label in tiles)]
    return draw_figure(Table(name, title, columns, rows), 2.4, paint)


def _heads(figure: Canvas, tiles: _Tiles) -> list[str]:
    """The headings in lines no wider than a map; the figure grows by the lines beyond the first."""
    # Points: a letter is some .6 of its height wide.
    wide = int(WIDTH * 72 / (0.6 * TEXT * len(tiles)))
    heads = [textwrap.fill(head, wide, break_on_hyphens=False) for head in tiles]
    lines = max(head.count("\n") for head in heads)
    figure.set_figheight(figure.get_figheight() + lines * 1.5 * TEXT / 72)
    return heads


def _side(size: _Size) -> int:
    """Cells of a tile in each direction."""
    return -(-max(size) // MOST_TILES)


def binned(values: Array, size: _Size) -> Array:
    """Means of `values` `[M]` over square tiles, `[rows of tiles, columns of tiles]`.

    150 rows and columns make tiles of 3 x 3 cells, 50 in each direction; the last ones may be cut off.
    """
    row, column = np.indices(size).reshape(2, -1) // _side(size)
    shape = int(row[-1]) + 1, int(column[-1]) + 1
    tile = row * shape[1] + column
    return (np.bincount(tile, values) / np.bincount(tile)).reshape(shape)


def _draw_tiles(axes: Axes, on: Array, possible: BoolArray, size: _Size, reach: int) -> None:
    """Draw one tile per located cell.

    Args:
        axes: canvas.
        on: `[M, M]`, row x: share of the detections in x after which a cell is sensed.
        possible: `[M, M]`, row x: cells the target may be in.
        size: rows and columns of the grid.
        reach: cells shown on each side of the located one.
    """
    rows, columns = size
    side = 2 * reach + 2  # 2 reach + 1 cells, and one between tiles
    x, j = np.nonzero(possible | (on > 0))
    # The tile of x begins at (column, row) * side, with x itself at + reach, and j relative to it. In a grid of 10
    # columns, x = 23 and j = 34: one down, one right.
    left = x % columns * side + reach + j % columns - x % columns
    top = x // columns * side + reach + j // columns - x // columns
    share, can = on[x, j], possible[x, j]
    for colour, length in (
        (PALE, np.where(can & (share < 1), _SIDE, 0.0)),
        (BLUE, np.where(can, _SIDE * share**0.5, 0.0)),  # the area is the share
        (VERMILION, np.where(can, 0.0, _SIDE * share**0.5)),
    ):
        _squares(axes, colour, np.stack([left, top], axis=1) + 0.5, length)
    row, column = np.divmod(np.arange(rows * columns), columns)
    centre = reach + 0.5
    axes.plot(column * side + centre, row * side + centre, ".", color=INK, markersize=12 / side)
    # A frame around each tile: with reach 1 tiles are 4 apart and their cells begin at 0, 4, ..., frames at -0.5, 3.5.
    grid_lines(axes, *(np.arange(count + 1) * side - 0.5 for count in (columns, rows)))
    axes.set(xlim=(-1, columns * side), ylim=(rows * side, -1), aspect="equal")
    axes.set_axis_off()


def _squares(axes: Axes, colour: str, centre: Array, length: Array) -> None:
    """Squares around centres `[K, 2]`, as one path, which keeps the file small; none of length 0."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    drawn = length > 0
    corners = 0.5 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    points = centre[drawn, None] + corners * length[drawn, None, None]
    path = Path.make_compound_path_from_polys(points)
    axes.add_patch(PathPatch(path, facecolor=colour, edgecolor="none"))


def _reach(cells: BoolArray, size: _Size) -> int:
    """Rows or columns from a located cell to its farthest one, 1 to 3: larger tiles are too small to see."""
    located, other = (np.divmod(each, size[1]) for each in np.nonzero(cells))
    return int(np.clip(np.abs(np.subtract(located, other)).max(initial=0), 1, 3))
