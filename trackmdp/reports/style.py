"""Style and output of figures: reproducible bytes, legible at phone width, colours for light and dark schemes."""

from __future__ import annotations

import html
import io
import re
import textwrap
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, cycle
from typing import TYPE_CHECKING, Any, TypeAlias

from trackmdp.arrays.types import AnyArray
from trackmdp.errors import UserError
from trackmdp.reports.tables import Table
from trackmdp.reports.ticks import Axes as Axes
from trackmdp.reports.ticks import label_ticks

if TYPE_CHECKING:  # an extra, and a second to import
    from matplotlib import figure

Canvas: TypeAlias = "figure.Figure"
Say: TypeAlias = Callable[[str], None]
"""Receives short progress messages."""

WIDTH = 4.3
"""Inches: the width of a phone, so that letters keep their size there."""
TEXT = 10.5
"""Points. A figure is 310 points wide, on a phone 330 pixels: letters of 11 pixels there, larger ones elsewhere."""
INK, LINE, PAGE, PALE = "#1b1b1c", "#c4c4c5", "#fffffe", "#dcebf4"
BLUE, VERMILION, GREY = "#0072b2", "#d55e01", "#5c5c5d"
PALETTE = {
    INK: "text",
    LINE: "line",
    PAGE: "page",
    PALE: "pale",
    GREY: "grey",
    BLUE: "blue",
    VERMILION: "vermilion",
    "#00845c": "green",
    "#a33fa3": "purple",
    "#a87900": "amber",
    "#0d7f86": "teal",
    "#b3123f": "crimson",
    "#667700": "olive",
}
"""Colours of the files, and their names in the style sheet of the page, which has other values in the dark scheme."""


@dataclass(frozen=True)
class Look:
    """Colour, marker and line of one curve: `vars` of it are arguments of matplotlib's `plot`."""

    color: str
    marker: str = ""
    linestyle: str = "-"
    linewidth: float = 1.4
    zorder: float = 2.0


# Hues far apart, and a marker for each: for print without colours, and readers with few of them.
LOOKS = (
    Look(VERMILION, "o"),
    Look(BLUE, "D"),
    Look("#00845c", "s"),
    Look("#a33fa3", "^"),
    Look("#a87900", "v"),
    Look("#b3123f", "P"),
    Look("#0d7f86", "X"),
    Look("#667700", "*"),
)
"""Looks of learned policies, in the order of a report."""
# A wide band below the lines: a line on it is seen to reach the optimum.
REFERENCES = {
    "best known": Look(LINE, "", "-", 6.0, 1.0),
    "Q_MDP": Look(GREY, "x", "--"),
    "all on": Look(GREY, "+", ":"),
    "printed bound": Look(INK, "", ":", 1.0),
    "valid bound": Look(INK, "", "--", 1.0),
    "clocked bound": Look(INK, "", "-.", 1.0),
}
"""Looks of the policies and bounds that learned policies are compared with."""


def looks_of(labels: Sequence[str]) -> dict[str, Look]:
    """A look for each method; from the ninth on a colour comes again, dotted."""
    dotted = [replace(look, linestyle=":") for look in LOOKS]
    return dict(zip(labels, chain(LOOKS, cycle(dotted)), strict=False))


@dataclass(frozen=True)
class Figure:
    """A finished figure.

    Attributes:
        table: its numbers; `table.name` is the name of its files, `table.caption` its caption, with n.
        svg, png: contents of the files.
    """

    table: Table
    svg: bytes
    png: bytes

    def html(self) -> str:
        """The figure on the page: drawing in the colours of the page, caption, and numbers."""
        title = html.escape(self.table.caption)
        drawing = _inline(self.svg.decode(), title)
        return (
            f'<figure id="{self.table.name}">{drawing}<figcaption>{title}</figcaption>'
            f"<details><summary>Numbers</summary>{self.table.html()}</details></figure>"
        )


def draw_figure(table: Table, height: float, paint: Callable[[Canvas], None]) -> Figure:
    """A figure `WIDTH` x `height` inches that `paint` draws on."""
    try:
        import matplotlib
    except ValueError as error:
        raise UserError(f"MPLBACKEND: {error}") from None
    from matplotlib.figure import Figure as New

    svg, png = io.BytesIO(), io.BytesIO()
    # Settings and filters hold inside only: a notebook keeps its own. `Figure` without pyplot needs no display.
    with warnings.catch_warnings(), matplotlib.rc_context():
        # Not those of a `matplotlibrc`, also read from the current folder: it may have LaTeX run on the labels.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_settings(table.name))
        # A name may have letters that the font lacks: text in the SVG, boxes in the PNG.
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        figure = New(figsize=(WIDTH, height), dpi=160, layout="constrained")
        paint(figure)
        for axes in figure.axes:
            label_ticks(axes)
        # Without date and version, which would change the bytes.
        figure.savefig(png, format="png", metadata={"Software": None})
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return Figure(table, svg.getvalue(), png.getvalue())


def tidy(axes: Axes) -> None:
    """Light grid, and no box around the axes."""
    axes.grid(True, color=LINE, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def grid_lines(axes: Axes, x: AnyArray, y: AnyArray) -> None:
    """Lines between the cells of a grid, at the rising places `x` and `y`."""
    axes.vlines(x, y[0], y[-1], colors=LINE, linewidths=0.5)
    axes.hlines(y, x[0], x[-1], colors=LINE, linewidths=0.5)


def legend(figure: Canvas, axes: Axes) -> None:
    """A legend below the axes, in as many columns as fit."""
    found = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    names = [textwrap.fill(name, 40, break_on_hyphens=False) for name in found]
    # Points: a letter is some .6 of its height wide, line and gaps take four heights.
    wide = (4 + 0.6 * max(map(len, names), default=0)) * TEXT
    columns = min(3, max(1, int(WIDTH * 72 / wide)))
    # Every figure has room for two lines; for more it grows.
    lines = -(-sum(name.count("\n") + 1 for name in names) // columns)
    figure.set_figheight(figure.get_figheight() + max(0, lines - 2) * 1.5 * TEXT / 72)
    figure.legend(
        [*found.values()], names, loc="outside lower center", ncols=columns, frameon=False
    )


def _settings(name: str) -> Any:
    texts = ("font.size", "axes.titlesize", "axes.labelsize", "xtick.labelsize", "ytick.labelsize")
    inked = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    pages = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
    return {
        "svg.hashsalt": name,  # else ids are random; by name, since ids on one page must differ
        "svg.fonttype": "none",  # text can be searched, and is smaller than outlines of letters
        "text.parse_math": False,  # a label such as $x^{$ is a name
        "font.family": "DejaVu Sans",
        **dict.fromkeys((*texts, "legend.fontsize"), TEXT),
        **dict.fromkeys(inked, INK),
        **dict.fromkeys(pages, PAGE),
        "axes.linewidth": 0.6,
        "lines.markersize": 4.5,
    }


def _inline(svg: str, title: str) -> str:
    """The drawing as part of a page; its title is HTML."""
    body = svg[svg.index("<svg") :]
    # matplotlib's style sheet would hold for the whole page.
    body = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", body, flags=re.DOTALL)
    view = re.search(r'viewBox="([^"]+)"', body)
    assert view
    rest = body.partition(">")[2]
    for colour, variable in PALETTE.items():
        rest = rest.replace(colour, f"var(--{variable})")
    # Only ids that are referred to: others come once in each figure.
    used = set(re.findall(r'(?:url\(|href=")#([^")]+)', rest))
    rest = re.sub(r' id="([^"]+)"', lambda found: found[0] if found[1] in used else "", rest)
    head = (
        f'<svg class="chart" role="img" viewBox="{view[1]}" xmlns="http://www.w3.org/2000/svg" '
        'xmlns:xlink="http://www.w3.org/1999/xlink"'
    )
    return f'{head} aria-label="{title}">{rest}'
