"""One figure of tracking with few sensors: located, missed, inferred from the miss, found again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray
from trackmdp.reports.results import Mapped
from trackmdp.reports.style import (
    BLUE,
    INK,
    VERMILION,
    Axes,
    Canvas,
    Figure,
    draw_figure,
    grid_lines,
)
from trackmdp.reports.tables import Column, Rows, Table

_MARGIN = 1
"""Cells shown around all that happens."""


@dataclass(frozen=True)
class Scene:
    """One moment.

    Attributes:
        title: the event.
        belief: `[M]`, probability of the target being in each cell, before the sensors of the moment report.
        on: `[M]`, sensors that are on.
        target: its cell; None in a scene of the belief alone.
        found: whether a sensor reports it.
    """

    title: str
    belief: Array
    on: BoolArray
    target: int | None
    found: bool

    @property
    def cells(self) -> list[int]:
        """Cells in which the target may be, or that are sensed."""
        return np.flatnonzero((self.belief > 0) | self.on).tolist()


def scenes(drawn: Mapped) -> list[Scene]:
    """The story from the cell with the likeliest miss that the next step makes good; empty without such a miss.

    No chance: the target moves to the likeliest unsensed cell, then to the likeliest sensed one.
    """
    if drawn.choices < 2 or drawn.averaged or not drawn.kernel.nnz:
        return []
    kernel, first, second, after = drawn.kernel, drawn.on(0), drawn.on(1), drawn.after
    # Row x: the mass that the first set left unsensed after a detection in x; `after` is the same after one more move.
    missed = kernel - kernel.multiply(first)
    # With modes the next move depends on the last one, and sensors may miss: such a story would be another one.
    if abs(missed @ kernel - after).max() > 1e-12:
        return []
    again = after.multiply(second).sum(axis=1)
    x = int(again.argmax())
    if not again[x] > 1e-9:
        return []

    def row(table: sparse.csr_array) -> Array:
        return np.asarray(table[[x]].toarray()[0])

    left, sensed = row(missed), row(second) > 0
    # The likeliest pair of an unsensed cell y and a sensed cell z after it.
    pairs = left[:, None] * kernel.toarray() * sensed
    y, z = np.unravel_index(int(pairs.argmax()), pairs.shape)
    none, gone = np.zeros(len(left), bool), left.sum()
    here = np.arange(len(left)) == x
    return [
        Scene("1  located", here.astype(np.float64), none, x, found=True),
        Scene("2  moves; missed", row(kernel), row(first) > 0, int(y), found=False),
        Scene("3  after the miss", left / gone, none, None, found=False),
        Scene("4  found again", row(after) / gone, sensed, int(z), found=True),
    ]


def idea_figure(drawn: Mapped) -> Figure | None:
    """Belief, sensors, miss and detection on the grid; None where no miss is made good."""
    story = scenes(drawn)
    if not story:
        return None
    columns = drawn.size[1]
    row, column = np.divmod([cell for scene in story for cell in scene.cells], columns)
    # Rows and columns of the part of the grid that is drawn: begin and end, which does not belong to it.
    part = [
        (max(int(each.min()) - _MARGIN, 0), min(int(each.max()) + _MARGIN + 1, length))
        for each, length in zip((row, column), drawn.size, strict=True)
    ]

    def paint(figure: Canvas) -> None:
        for axes, scene in zip(figure.subplots(2, 2).ravel(), story, strict=True):
            _paint(axes, scene, columns, part)

    rows: Rows = [
        [
            *(scene.title, cell // columns + 1, cell % columns + 1),
            *(float(scene.belief[cell]), bool(scene.on[cell])),
        ]
        for scene in story
        for cell in scene.cells
    ]
    heads = [*map(Column, ("moment", "row", "column")), Column("probability", 3), Column("sensed")]
    title = (
        "Shade: probability of the target. Frame: sensor on. Disc: target detected. Ring: missed. "
        f"{drawn.label}"
    )
    return draw_figure(Table("story", title, heads, rows), 4.6, paint)


def _paint(axes: Axes, scene: Scene, columns: int, part: list[tuple[int, int]]) -> None:
    from matplotlib.patches import Rectangle

    (top, bottom), (left, right) = part
    for cell in scene.cells:
        row, column = divmod(cell, columns)
        # Shades by opacity, so that one colour of the page serves; the likeliest cell is the darkest.
        likely = float(scene.belief[cell] / scene.belief.max())
        shade = 0.15 + 0.75 * likely if likely else 0.0
        axes.add_patch(
            Rectangle((column, row), 1, 1, facecolor=BLUE, alpha=shade, edgecolor="none")
        )
        if scene.on[cell]:
            corner = (column + 0.09, row + 0.09)
            axes.add_patch(Rectangle(corner, 0.82, 0.82, fill=False, edgecolor=INK, linewidth=1.6))
    grid_lines(axes, np.arange(left, right + 1.0), np.arange(top, bottom + 1.0))
    if scene.target is not None:
        row, column = divmod(scene.target, columns)
        filled = VERMILION if scene.found else "none"
        axes.plot([column + 0.5], [row + 0.5], "o", color=VERMILION, mfc=filled, ms=9, mew=2)
    axes.set_title(scene.title, loc="left")
    axes.set(xlim=(left - 0.05, right + 0.05), ylim=(bottom + 0.05, top - 0.05), aspect="equal")
    axes.set_axis_off()
