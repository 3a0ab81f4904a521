"""Maps of one policy: the sets it senses from each located cell, and what it earns from each start cell.

Of a large grid the number of sensors in place of the sets, and means over square tiles in place of cells.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from trackmdp.reports.results import MotionTable, Sensed
from trackmdp.reports.style import INK, LINE, Axes, Canvas, Figure, draw_figure, power
from trackmdp.reports.tables import Cell, Column, Table
from trackmdp.world.model import Array, BoolArray

# 20 x 20: with tiles of four to six cells each, more would not be seen on a page.
MOST_MAP_CELLS = 400
"""Cells of a grid whose sets are still drawn, one tile around each located cell."""
MOST_TILES = 60
"""Tiles of a map in each direction: a square of 3 pixels on a page, and 3,600 rows of its table."""
LEVELS = 24
"""Shades of a colour scale."""
_Size: TypeAlias = tuple[int, int]
"""Rows and columns of a grid."""
_Layers: TypeAlias = dict[str, Array]
"""Numbers `[M]`, one for each cell, by what they are called."""
_ON, _OFF, _IDLE = "#0072b2", "#dcebf4", "#d55e01"
_AFTER = ("just located (n = 0)", "after one miss (n = 1)")
_SIDE = 0.92
"""Of a cell's square: the gap shows the grid without lines."""
_AVERAGED = " Plans differ by what is remembered or told: filled areas are shares of the detections in a tile's cell."


@dataclass(frozen=True)
class Scale:
    """A scale of colour: matplotlib's name of its colours, the values at its ends, whether it is logarithmic."""

    colours: str
    low: float
    high: float
    log: bool = False


def policy_map(name: str, where: str, policy: Sensed, motion: MotionTable, size: _Size) -> Figure:
    """Around each located cell, the sensors that are on after no miss and after one; of a large grid how many are.

    Where the first set leaves nothing out, a miss cannot happen, and nothing is drawn for it.
    """
    cells, choices = len(policy.value), policy.choices
    if cells > MOST_MAP_CELLS:
        return _intensity_map(name, where, policy, size)
    shown = list(range(min(choices, 2)))
    # `[n][M, M]`, row x belonging to the target located in x; shares of the detections there, or bool.
    chains = [policy.on(n).toarray() for n in range(choices)]
    possible = _possible(chains, motion, len(shown))

    def paint(figure: Canvas) -> None:
        # A stored plan has a set for every n; where the miss cannot happen it is arbitrary, and never comes about.
        drawn = [chains[n] * possible[n].any(axis=1, keepdims=True) for n in shown]
        # One size of tile for all, so that they can be compared: that of the farthest cell drawn.
        reach = max(_farthest(can | (on > 0), size[1]) for can, on in zip(possible, drawn, strict=True))
        for axes, n in zip(np.atleast_1d(figure.subplots(len(shown), 1)), shown, strict=True):
            _tiles(axes, drawn[n], possible[n], size, max(reach, 1))
            axes.set_title(_AFTER[n])

    rows: list[list[Cell]] = [
        [x, n, (on := chains[n][x]).sum().item(), int(possible[n][x].sum()), _cells_text(on, size[1])]
        for x in range(cells)
        for n in shown
        # No row where this many misses cannot happen.
        if possible[n][x].any()
    ]
    sensed = Column("cells sensed", 2 if policy.averaged else 0)
    columns = [Column("located in cell"), Column("misses n"), sensed, Column("possible cells")]
    title = f"Sets sensed around each located cell, {where}"
    table = Table(f"sets-{name}", title, [*columns, Column("which (row.column)")], rows)

    def average(counted: Array, n: int) -> float:
        reached = possible[n].any(axis=1)
        return float(counted[reached].sum(axis=1).mean()) if reached.any() else 0.0

    text = "Each tile is one located cell and its neighbourhood. " + " ".join(
        f"At n = {n}: {average(chains[n], n):.2f} cells sensed, {average(possible[n] * (1.0 - chains[n]), n):.2f} "
        "possible ones left out on average."
        for n in shown
    )
    text += _AVERAGED if policy.averaged else ""
    return draw_figure(title, text, table, 0.4 + 3.9 * len(shown), paint)


def _intensity_map(name: str, where: str, policy: Sensed, size: _Size) -> Figure:
    """How many cells are sensed after no miss and after one, by where the target was located."""
    shown = range(min(policy.choices, 2))
    layers = {f"cells sensed at n = {n}": policy.on(n).sum(axis=1).astype(np.float64) for n in shown}
    scale = Scale("viridis", 0.0, _ends([binned(number, size) for number in layers.values()])[1])
    title = f"Cells sensed, by where the target was located, {where}"
    return _shaded_map(f"sets-{name}", title, layers, _AFTER, size, 3.2, {scale: slice(None)})


VALUE, MISSING, OF_QMDP = "value V(x)", "missing to the clocked bound", "the same, Q_MDP"
"""Layers of a value map."""


def _layers(policy: Sensed, motion: MotionTable) -> _Layers:
    # Both against the clocked bound, which is the optimum wherever a policy attains it.
    layers = {VALUE: policy.value, MISSING: _rounded(motion.clocked - policy.value)}
    if np.isfinite(motion.qmdp).all():
        layers[OF_QMDP] = _rounded(motion.clocked - motion.qmdp)
    return layers


def value_scales(every: Iterable[tuple[Sensed, MotionTable]]) -> tuple[Scale, Scale]:
    """The two scales of colour that all value maps of a page share: of values, and of what is missing."""
    drawn = [_layers(*each) for each in every]
    low, high = _ends([layers[VALUE] for layers in drawn])
    most = _ends([values for layers in drawn for name, values in layers.items() if name != VALUE])[1]
    # A good policy misses a thousandth of what Q_MDP does: powers of ten, from a hundred-thousandth of the most.
    most = most if most > 0 else 1.0
    return Scale("viridis", low, high), Scale("magma_r", 1e-5 * most, most, log=True)


def value_map(
    name: str, where: str, policy: Sensed, motion: MotionTable, size: _Size, scales: tuple[Scale, Scale]
) -> Figure:
    """Exact value per start cell, and what the policy and Q_MDP, where it was valued, miss to the clocked bound."""
    # Two scales of colour: values and what is missing are not to be compared by shade. Bright is good in both, much in
    # viridis and little in magma_r.
    parts = dict(zip(scales, (slice(1), slice(1, None)), strict=True))
    title = f"Value of each start cell, and what is missing of the clocked bound, {where}"
    heads = (VALUE, "below the bound", "Q_MDP's")
    return _shaded_map(f"value-{name}", title, _layers(policy, motion), heads, size, 2.1, parts)


def _shaded_map(
    name: str, title: str, layers: _Layers, heads: Sequence[str], size: _Size, height: float, scales: dict[Scale, slice]
) -> Figure:
    """Layers of one number a cell side by side, under their `heads`; each scale is that of some of them."""
    means = {label: binned(values, size) for label, values in layers.items()}

    def paint(figure: Canvas) -> None:
        every = list(np.atleast_1d(figure.subplots(1, len(means))))
        for scale, part in scales.items():
            _shade(figure, every[part], list(means.values())[part], scale)
        for axes, head in zip(every, heads, strict=False):
            axes.set_title(head)

    return draw_figure(title, _said(layers, size), _tiles_table(name, title, means, size), height, paint)


def _side(size: _Size) -> int:
    """Cells of a tile in each direction: as few as `MOST_TILES` allows, one on most grids."""
    return -(-max(size) // MOST_TILES)


def binned(values: Array, size: _Size) -> Array:
    """Means of `values` `[M]` over square tiles, `[rows of tiles, columns of tiles]`.

    150 rows and columns make tiles of 3 x 3 cells, 50 in each direction; those at the end may be cut off.
    """
    begins = [np.arange(0, length, _side(size)) for length in size]
    sums = np.add.reduceat(np.add.reduceat(values.reshape(size), begins[0], axis=0), begins[1], axis=1)
    rows, columns = (np.diff([*begin, length]) for begin, length in zip(begins, size, strict=True))
    return sums / (rows[:, None] * columns)


def _said(layers: _Layers, size: _Size) -> str:
    """Mean and range of each layer, over cells, and what is drawn."""
    said = [f"{label}: mean {v.mean():.2f}, from {v.min():.2f} to {v.max():.2f}" for label, v in layers.items()]
    text = "; ".join(said)
    side = _side(size)
    return f"{text}." if side == 1 else f"{text}. Drawn are means over tiles of {side} x {side} cells."


def _tiles_table(name: str, title: str, means: _Layers, size: _Size) -> Table:
    """A row for each tile, called by its first cell."""
    side, layers = _side(size), list(means.values())
    first = "" if side == 1 else "first "
    columns = [Column(f"{first}start cell"), Column(f"{first}row"), Column(f"{first}column")]
    rows: list[list[Cell]] = [
        # Tile (2, 3) of 3 x 3 cells on a grid of 150 columns begins in row 6, column 9, cell 909, counted from 0.
        [side * (i * size[1] + j), side * i + 1, side * j + 1, *(float(layer[i, j]) for layer in layers)]
        for i, j in np.ndindex(*layers[0].shape)
    ]
    return Table(name, title, [*columns, *(Column(label, 3) for label in means)], rows)


def _ends(layers: Sequence[Array]) -> tuple[float, float]:
    # A single outlying cell would leave one shade to all others: the scale ends at the 2nd and the 98th of a hundred.
    low, high = np.percentile(np.concatenate([values.ravel() for values in layers]), (2, 98))
    return float(low), float(high)


def _shade(figure: Canvas, every: Sequence[Axes], layers: Sequence[Array], scale: Scale) -> None:
    """Shaded cells of one or more layers, with the scale they share."""
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    # 24 shades: the colour bar is then 24 rectangles in the SVG, and not 256.
    colours = colormaps[scale.colours].resampled(LEVELS)
    norm = (LogNorm if scale.log else Normalize)(scale.low, scale.high)
    for axes, values in zip(every, layers, strict=True):
        # On a logarithmic scale 0 has no place; it is what lies beyond its low end.
        shade = axes.pcolormesh(np.maximum(values, scale.low), cmap=colours, norm=norm)
        # Row 1 on top, as in the numbering of cells.
        axes.invert_yaxis()
        axes.set(aspect="equal", xticks=[], yticks=[])
    # An arrow at an end of the bar: some cells lie beyond it.
    beyond = (min(values.min() for values in layers) < scale.low, max(values.max() for values in layers) > scale.high)
    ends = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}[beyond]
    bar = figure.colorbar(
        shade, ax=list(every), orientation="horizontal", pad=0.03, fraction=0.07, aspect=12 * len(every), extend=ends
    )
    assert bar.solids is not None
    bar.solids.set_rasterized(False)  # a page takes no pictures
    bar.locator = LogLocator(numticks=4) if scale.log else MaxNLocator(3)
    if scale.log:
        bar.minorticks_off()
        bar.formatter = FuncFormatter(power)
    bar.update_ticks()


def _rounded(values: Array) -> Array:
    """`values` with entries below 1e-9, which are rounding errors, set to 0."""
    return np.where(np.abs(values) < 1e-9, 0.0, values)


def _possible(chains: Sequence[Array], motion: MotionTable, steps: int) -> list[BoolArray]:
    """`[M, M]` each: where the target may be after n misses and one more move."""
    # `[M, M]` joint mass: row x, the target located in x and moved once. Sensed mass is taken out before the next
    # move: had it been there, it would have been located.
    mass = motion.kernel.toarray()
    found = []
    for n in range(steps):
        found.append(mass > 0)
        mass = (mass * (1.0 - chains[n])) @ motion.kernel
    return found


def _tiles(axes: Axes, on: Array, possible: BoolArray, size: _Size, reach: int) -> None:
    """Draw one tile per located cell.

    Args:
        axes: where.
        on: `[M, M]`, row x: cells sensed with the target located in x, bool or a share.
        possible: `[M, M]`, row x: cells it can be in.
        size: rows and columns of the grid.
        reach: cells shown on each side of the located one.
    """
    rows, columns = size
    # 2 reach + 1 cells and one between tiles; squares are (left, top, side).
    side = 2 * reach + 2
    groups: dict[str, list[tuple[float, float, float]]] = {_OFF: [], _ON: [], _IDLE: []}
    for x in range(rows * columns):
        row, column = divmod(x, columns)
        # The tile of x begins at (column, row) * side; its centre, x itself, is at + reach, and j is drawn relative to
        # it. In a grid of 10 columns, x = 23 and j = 34: one down, one right.
        for j in np.flatnonzero(possible[x] | (on[x] > 0)):
            down, across = j // columns - row, j % columns - column
            left, top, share = column * side + reach + across, row * side + reach + down, on[x, j]
            for colour, filled in ((_OFF, share < 1), (_ON, share)) if possible[x, j] else ((_IDLE, share),):
                length = _SIDE * float(filled) ** 0.5  # the area is the share
                if length:
                    margin = 0.5 * (_SIDE - length)
                    groups[colour].append((left + margin, top + margin, length))
    _squares(axes, groups)
    places = (divmod(x, columns) for x in range(rows * columns))
    centres = [(column * side + reach + 0.5, row * side + reach + 0.5) for row, column in places]
    axes.plot(*np.array(centres).T, ".", color=INK, markersize=12 / side)
    # A frame around each tile: with reach 1 tiles are 4 apart and their cells begin at 0, 4, ..., frames at -0.5, 3.5.
    right, below = columns * side - 0.5, rows * side - 0.5
    axes.vlines(np.arange(columns + 1) * side - 0.5, -0.5, below, colors=LINE, linewidths=0.5)
    axes.hlines(np.arange(rows + 1) * side - 0.5, -0.5, right, colors=LINE, linewidths=0.5)
    axes.set(xlim=(-1, columns * side), ylim=(rows * side, -1), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color(LINE)


def _squares(axes: Axes, groups: dict[str, list[tuple[float, float, float]]]) -> None:
    """All squares of one colour as one path, which keeps the file small."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    codes = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    for colour, squares in groups.items():
        if not squares:
            continue
        points = [[(x, y), (x + s, y), (x + s, y + s), (x, y + s), (x, y)] for x, y, s in squares]
        path = Path(np.array(points).reshape(-1, 2), codes * len(squares))
        axes.add_patch(PathPatch(path, facecolor=colour, edgecolor="none"))


def _farthest(cells: BoolArray, columns: int) -> int:
    located, sensed = np.nonzero(cells)
    if not len(located):
        return 0
    away = np.maximum(np.abs(located // columns - sensed // columns), np.abs(located % columns - sensed % columns))
    # Tiles of 7 x 7 cells at most: with far jumps they would be too small to see. Cells farther away overlap other
    # tiles then.
    return min(int(away.max()), 3)


def _cells_text(on: Array | BoolArray, columns: int) -> str:
    return " ".join(f"{j // columns + 1}.{j % columns + 1}" for j in np.flatnonzero(on))
