"""Pictures drawn with matplotlib (extra `report`)."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Sequence
from importlib.util import find_spec
from itertools import cycle
from typing import Any

from numpy import asarray, isnan

from trackmdp.errors import require
from trackmdp.notebook.pictures import Heat, Picture

BLUE, ORANGE, INK = "#0072b2", "#d55e01", "#1b1b1c"
_SIZE = (5.4, 3.6)
"""Inches."""


def draw(picture: Picture, axes: Any = None) -> Any:
    """Draw on matplotlib axes, by default on those of a new figure; returns them.

    Raises:
        UserError: matplotlib is not installed.
    """
    require("matplotlib", "report", "plot()")
    if axes is None:
        from matplotlib import pyplot

        axes = pyplot.subplots(figsize=_SIZE, layout="constrained")[1]
    (_heat if isinstance(picture, Heat) else _lines)(picture, axes)
    axes.set_title(picture.title, loc="left", fontsize=10)
    return axes


def _heat(picture: Any, axes: Any) -> None:
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import MaxNLocator

    rows, columns = picture.values.shape
    image = axes.imshow(picture.values, cmap="cividis", interpolation="nearest")
    # Numbers of misses or visits: no label stands between two of them.
    whole = bool((picture.values == picture.values.round())[~isnan(picture.values)].all())
    bar = axes.figure.colorbar(image, ax=axes, label=picture.label)
    bar.locator = MaxNLocator(integer=whole, nbins=6)
    axes.set_xlabel("column")
    axes.set_ylabel("row")
    for which, length in ((axes.set_xticks, columns), (axes.set_yticks, rows)):
        step = -(-length // 8)  # eight labels at most
        which(range(0, length, step), [str(place + 1) for place in range(0, length, step)])
    for cell in picture.mark:
        row, column = divmod(cell, columns)
        corner = (column - 0.42, row - 0.42)
        axes.add_patch(Rectangle(corner, 0.84, 0.84, fill=False, edgecolor=ORANGE, linewidth=1.5))
    if picture.path:
        down, across = zip(*(divmod(cell, columns) for cell in picture.path), strict=True)
        axes.plot(across, down, color=ORANGE, linewidth=1)
        faces = ["none" if missed else ORANGE for missed in picture.hollow]
        axes.scatter(across, down, s=24, facecolors=faces, edgecolors=ORANGE, zorder=3)


def _lines(picture: Any, axes: Any) -> None:
    from matplotlib.ticker import MaxNLocator

    for name, heights in picture.lines.items():
        # A line through the measurements: between two evaluations there is nothing.
        known = ~isnan(heights)
        if known.any():
            x = asarray(picture.x)[known]
            axes.plot(x, asarray(heights)[known], color=BLUE, marker=".", label=name)
    looks = cycle(((ORANGE, "-"), (INK, "--"), ("#5c5c5d", ":")))
    for (name, height), (color, style) in zip(picture.levels.items(), looks, strict=False):
        axes.axhline(height, linewidth=1.2, label=name, color=color, linestyle=style)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter("{x:,g}")
    axes.set_xlabel(picture.labels[0])
    axes.set_ylabel(picture.labels[1])
    if len(picture.lines) + len(picture.levels) > 1:
        axes.legend(fontsize=8)


def page_of(title: str, rows: Sequence[tuple[str, str]], picture: Picture | None) -> str:
    """A card as HTML, beside its picture where matplotlib is installed."""
    cells = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in rows
    )
    table = f"<table><caption><b>{html.escape(title)}</b></caption>{cells}</table>"
    if picture is None or find_spec("matplotlib") is None:
        return table
    stream = io.BytesIO()
    drawn(picture).save(stream, format="png")
    code = base64.b64encode(stream.getvalue()).decode()
    shown = f'<img style="max-width:100%" alt="{html.escape(picture.title)}" src="data:image/png;base64,{code}">'
    style = "display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start"
    return f'<div style="{style}">{table}{shown}</div>'


def drawn(picture: Picture) -> Any:
    """An image of PIL, which comes with matplotlib."""
    from matplotlib.figure import Figure
    from PIL import Image

    # Not pyplot's, which a notebook would show a second time.
    figure, stream = Figure(figsize=_SIZE, layout="constrained"), io.BytesIO()
    draw(picture, figure.subplots())
    figure.savefig(stream, format="png", dpi=110)
    return Image.open(stream).convert("RGB")
