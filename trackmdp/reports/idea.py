"""One figure of what tracking with few sensors is: located, moved and missed, what the miss says, found again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.reports.results import MotionTable, Sensed
from trackmdp.reports.style import INK, LINE, Axes, Canvas, Figure, draw_figure
from trackmdp.reports.tables import Cell, Column, Table, paragraphs
from trackmdp.world.model import Array, BoolArray

BELIEF, TARGET = "#0072b2", "#d55e01"
_MARGIN = 1
"""Cells shown around all that happens."""


@dataclass(frozen=True)
class Scene:
    """One moment.

    Attributes:
        title: what happens.
        belief: `[M]`, how likely the target is in each cell, before the sensors of the moment have said anything.
        on: `[M]`, sensors that are on.
        target: the cell it is in; None where the scene is about the belief alone.
        found: whether a sensor reports it.
    """

    title: str
    belief: Array
    on: BoolArray
    target: int | None
    found: bool


def scenes(policy: Sensed, motion: MotionTable) -> list[Scene]:
    """The story from the cell where a miss that is made good at the next step is likeliest; none where there is none.

    Nothing is drawn by chance: the target goes to the likeliest unsensed cell, then to the likeliest sensed one.
    """
    if policy.choices < 2 or policy.averaged:
        return []
    kernel, first, second = motion.kernel, policy.on(0), policy.on(1)
    # Rows belong to located cells: the mass that the first set left unsensed, and the same moved once more.
    missed = kernel - kernel.multiply(first)
    after = missed @ kernel
    again = np.asarray(after.multiply(second).sum(axis=1)).ravel()
    x = int(again.argmax())
    if not again[x] > 1e-9:
        return []

    def row(table: sparse.csr_array) -> Array:
        return np.asarray(table[[x]].toarray()[0])

    left, sensed = row(missed), row(second).astype(bool)
    # The likeliest pair of an unsensed cell y and a sensed cell z after it; y is one of a few.
    unsensed = np.flatnonzero(left)
    pairs = left[unsensed, None] * np.where(sensed, kernel[unsensed].toarray(), 0.0)
    y, z = np.unravel_index(int(pairs.argmax()), pairs.shape)
    none, gone = np.zeros(len(left), dtype=bool), left.sum()
    return [
        Scene("1  located", np.where(np.arange(len(left)) == x, 1.0, 0.0), none, x, found=True),
        Scene("2  moves; missed", row(kernel), row(first).astype(bool), int(unsensed[y]), found=False),
        Scene("3  what the miss says", left / gone, none, None, found=False),
        Scene("4  found again", row(after) / gone, sensed, int(z), found=True),
    ]


def idea_figure(policy: Sensed, motion: MotionTable, size: tuple[int, int], where: str) -> Figure | None:
    """Belief, sensors, miss and re-detection on the grid; None where no miss that is made good can happen."""
    story = scenes(policy, motion)
    if not story:
        return None
    window = _window(story, size)

    def paint(figure: Canvas) -> None:
        for axes, scene in zip(figure.subplots(2, 2).ravel(), story, strict=True):
            _paint(axes, scene, size, window)

    rows: list[list[Cell]] = [
        [scene.title, cell // size[1] + 1, cell % size[1] + 1, float(scene.belief[cell]), bool(scene.on[cell])]
        for scene in story
        for cell in np.flatnonzero((scene.belief > 0) | scene.on).tolist()
    ]
    columns = [Column("moment"), Column("row"), Column("column"), Column("probability", 3), Column("sensed")]
    title = f"The idea in one figure, {where}"
    text = paragraphs("trackmdp.reports")["idea"]
    return draw_figure(f"{title}. {text}", text, Table("story", title, columns, rows), 4.6, paint)


def _window(story: list[Scene], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of the part of the grid in which all of it happens; the ends belong to it."""
    cells = np.flatnonzero(np.any([(scene.belief > 0) | scene.on for scene in story], axis=0))
    row, column = np.divmod(cells, size[1])
    top, left = max(int(row.min()) - _MARGIN, 0), max(int(column.min()) - _MARGIN, 0)
    return top, min(int(row.max()) + _MARGIN, size[0] - 1), left, min(int(column.max()) + _MARGIN, size[1] - 1)


def _paint(axes: Axes, scene: Scene, size: tuple[int, int], window: tuple[int, int, int, int]) -> None:
    from matplotlib.patches import Rectangle

    top, bottom, left, right = window
    likeliest = scene.belief.max()
    for cell in np.flatnonzero((scene.belief > 0) | scene.on):
        row, column = divmod(int(cell), size[1])
        # Shades by opacity, so that one colour of the page serves; the likeliest cell of each moment is the darkest.
        shade = 0.15 + 0.75 * float(scene.belief[cell] / likeliest) if scene.belief[cell] else 0.0
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=BELIEF, alpha=shade, edgecolor="none"))
        if scene.on[cell]:
            frame = Rectangle((column + 0.09, row + 0.09), 0.82, 0.82, fill=False, edgecolor=INK, linewidth=1.6)
            axes.add_patch(frame)
    axes.vlines(np.arange(left, right + 2), top, bottom + 1, colors=LINE, linewidths=0.5)
    axes.hlines(np.arange(top, bottom + 2), left, right + 1, colors=LINE, linewidths=0.5)
    if scene.target is not None:
        row, column = divmod(scene.target, size[1])
        filled = TARGET if scene.found else "none"
        axes.plot([column + 0.5], [row + 0.5], "o", color=TARGET, mfc=filled, ms=9, mew=2)
    axes.set_title(scene.title, loc="left")
    axes.set(xlim=(left - 0.05, right + 1.05), ylim=(bottom + 1.05, top - 0.05), aspect="equal")
    axes.set_axis_off()
