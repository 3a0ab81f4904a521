"""Style and output of figures: reproducible bytes, legible at phone width, colours for light and dark schemes."""

from __future__ import annotations

import html
import io
import math
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from trackmdp.reports.grouping import ORDER
from trackmdp.reports.tables import Table

if TYPE_CHECKING:  # an extra, and a second to import
    from matplotlib import axes, figure

Axes: TypeAlias = "axes.Axes"
Canvas: TypeAlias = "figure.Figure"
Say: TypeAlias = Callable[[str], None]
"""Receives short progress messages."""

WIDTH = 4.3
"""Inches; as wide as a phone, so that letters keep their size there."""
TEXT = 10.5
"""Points. A figure is 310 points wide and is shown 330 pixels wide on a phone: 11 pixels there, more elsewhere."""
INK, LINE, PAGE = "#1b1b1c", "#c4c4c5", "#fffffe"
# `_inline` replaces these very letters in the SVG: a colour that is not among them would stay as it is in the dark
# scheme.
PALETTE = {
    INK: "text",
    LINE: "line",
    PAGE: "page",
    "#d55e01": "vermilion",
    "#0072b2": "blue",
    "#00845c": "green",
    "#b0518c": "purple",
    "#5c5c5d": "grey",
    "#a87900": "amber",
    "#2a93c9": "sky",
    "#7a3e00": "brown",
    "#6a3fb5": "violet",
    "#b3123f": "crimson",
    "#0d7f86": "teal",
    "#667700": "olive",
    "#d1368a": "pink",
    "#dcebf4": "pale",
}
"""Colours of the files, and their names in the style sheet of the page, where they change with the scheme."""
_DPI = 160
# Raised digits as letters: matplotlib's own powers are formulas, which are switched off (`text.parse_math`).
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Look:
    """Colour, marker and line of one curve."""

    colour: str
    marker: str = ""
    line: str = "-"

    def of_line(self) -> dict[str, Any]:
        """Arguments of matplotlib's `plot` and `errorbar`."""
        return {"color": self.colour, "marker": self.marker, "linestyle": self.line}


# Marker and dashes differ as well as the colour, for print without colours and for who cannot tell them apart.
LOOKS = {
    "a2c": Look("#d55e01", "o"),
    "hindsight": Look("#0072b2", "D"),
    "ppo": Look("#00845c", "s"),
    "dqn": Look("#b0518c", "^"),
    "learned_kernel": Look("#2a93c9", "v"),
    "Q_MDP": Look("#5c5c5d", "x", "--"),
    "printed bound": Look("#a87900", "", ":"),
    "valid bound": Look("#667700", "", ":"),
    "clocked bound": Look("#7a3e00", "", "-."),
    "optimum": Look(INK, "+", "-"),
}
# For labels that are not listed, as of one algorithm with several options: first the colours that no list has, then
# those of methods that are not there.
_SPARE = ("#6a3fb5", "#b3123f", "#0d7f86", "#d1368a", *(LOOKS[name].colour for name in ORDER))


@dataclass(frozen=True)
class Figure:
    """A finished figure.

    Attributes:
        title: heading; says what n is.
        text: what the figure shows, in words, for who cannot see it.
        table: its numbers, by whose name its files are called.
        svg, png: contents of the files.
    """

    title: str
    text: str
    table: Table
    svg: bytes
    png: bytes

    def html(self) -> str:
        """For the page: the drawing in the page's colours, its text alternative, its numbers."""
        drawing = _inline(self.svg.decode(), self.table.name, self.title, self.text)
        return (
            f'<figure id="{self.table.name}">{drawing}<figcaption>{html.escape(self.title)}</figcaption>'
            f"<details><summary>Numbers</summary>{self.table.html()}</details></figure>"
        )


def looks_of(labels: Sequence[str]) -> dict[str, Look]:
    """The look of each label: its own in `LOOKS`, else one whose colour no other has, as long as colours last."""
    taken = {LOOKS[label].colour for label in labels if label in LOOKS}
    free = [colour for colour in _SPARE if colour not in taken] or list(_SPARE)
    others = [label for label in labels if label not in LOOKS]
    found = {
        label: Look(free[place % len(free)], "Pp*h<>"[place % 6], "--" if place < len(free) else ":")
        for place, label in enumerate(others)
    }
    return {label: LOOKS.get(label) or found[label] for label in labels}


@contextmanager
def canvas(height: float, name: str) -> Iterator[Canvas]:
    """An empty figure, `WIDTH` x `height` inches; `name` keeps the ids of several in one page apart."""
    import matplotlib
    from matplotlib.figure import Figure as New

    # Only inside: whoever calls this from a notebook keeps their own settings. `Figure` without pyplot needs no
    # display, and is let go of when it is no longer used.
    with matplotlib.rc_context(_settings(name)):
        yield New(figsize=(WIDTH, height), dpi=_DPI, layout="constrained")


def draw_figure(title: str, text: str, table: Table, height: float, paint: Callable[[Canvas], None]) -> Figure:
    """Paint and write one figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    # Both from one drawing. The metadata are emptied: a date or a version would change the bytes each time.
    svg, png = io.BytesIO(), io.BytesIO()
    with warnings.catch_warnings(), canvas(height, table.name) as figure:
        # A name may have letters that the font lacks, as of Chinese, or a tab: text in the SVG, boxes in the PNG.
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        paint(figure)
        # Lets the layout engine settle, which it does while drawing.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # what has been laid out need not be again for each format
        # savefig would lay out and draw twice more each time
        FigureCanvasAgg(figure).print_png(png, metadata={"Software": None})  # type: ignore[no-untyped-call]
        FigureCanvasSVG(figure).print_svg(svg, metadata={"Date": None, "Creator": None})  # type: ignore[no-untyped-call]
    return Figure(title, text, table, svg.getvalue(), png.getvalue())


def tidy(axes: Axes) -> None:
    """Light grid, no box around the axes, and tick labels for logarithmic axes of any range."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, StrMethodFormatter

    for axis in (axes.xaxis, axes.yaxis):
        scale, (low, high) = axis.get_scale(), axis.get_view_interval()
        # Over more than about two powers of ten the powers alone are labels enough.
        if scale == "log" and high > 50 * low:
            axis.set_major_formatter(FuncFormatter(power))
            axis.set_minor_formatter(NullFormatter())
        # Over less there may be one power or none in sight: 2 and 5 are labelled as well, as plain numbers.
        elif scale == "log":
            axis.set_minor_locator(LogLocator(subs=(2, 5)))
            for form in (axis.set_major_formatter, axis.set_minor_formatter):
                form(StrMethodFormatter("{x:,.6g}"))
    axes.grid(True, color=LINE, linewidth=0.5)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def power(value: float, _place: int | None = None) -> str:
    """A power of ten as text with raised digits, such as 10⁻³."""
    return f"10{f'{math.log10(value):.0f}'.translate(_RAISED)}"


def legend(figure: Canvas, axes: Axes, columns: int = 3, first: Sequence[str] = ()) -> None:
    """A legend below the axes, in `columns`; the labels in `first` come before the others."""
    handles, labels = axes.get_legend_handles_labels()
    # matplotlib lists lines before error bars; False sorts first and the sort is stable.
    order = sorted(range(len(labels)), key=lambda place: labels[place] not in first)
    ordered = ([handles[place] for place in order], [labels[place] for place in order])
    figure.legend(*ordered, loc="outside lower center", ncols=columns, fontsize=TEXT, frameon=False, columnspacing=1.2)


def _settings(name: str) -> Any:
    texts = ("font.size", "axes.titlesize", "axes.labelsize", "xtick.labelsize", "ytick.labelsize")
    inked = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
    pages = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
    return {
        # Ids in an SVG are random otherwise. By the figure's name, as several figures stand in one page, where ids
        # must differ.
        "svg.hashsalt": name,
        # Text stays text: it can be searched, read aloud, and is smaller than the outlines of its letters.
        "svg.fonttype": "none",
        "text.parse_math": False,  # a label is a name, and $x^{$ one that somebody may give
        "font.family": "DejaVu Sans",
        **dict.fromkeys(texts, TEXT),
        **dict.fromkeys(inked, INK),
        **dict.fromkeys(pages, PAGE),
        "xtick.minor.pad": 5.0,  # labels of short and long ticks on one line
        "axes.linewidth": 0.6,
        "lines.linewidth": 1.4,
        "lines.markersize": 4.5,
        "axes.unicode_minus": True,
    }


def _inline(svg: str, name: str, title: str, text: str) -> str:
    """The drawing as part of a page."""
    body = svg[svg.index("<svg") :]
    # Without these the drawing takes its style from the page: matplotlib's style sheet would hold for the page as a
    # whole.
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r"<style.*?</style>", "", body, flags=re.DOTALL)
    view = re.search(r'viewBox="([^"]+)"', body)
    assert view
    _, _, rest = body.partition(">")
    # Colours become variables of the page, which has other values for them in the dark scheme.
    for colour, variable in PALETTE.items():
        rest = rest.replace(colour, f"var(--{variable})")
    rest = re.sub(r"\n\s*", "\n", rest)
    used = set(re.findall(r'(?:url\(|href=")#([^")]+)', rest))  # the other names would be there once per figure
    rest = re.sub(r' id="([^"]+)"', lambda found: found[0] if found[1] in used else "", rest)
    head = (
        f'<svg class="chart" role="img" viewBox="{view[1]}" xmlns="http://www.w3.org/2000/svg" '
        f'xmlns:xlink="http://www.w3.org/1999/xlink" aria-labelledby="{name}-t {name}-d">'
    )
    return (
        f'{head}<title id="{name}-t">{html.escape(title)}</title><desc id="{name}-d">{html.escape(text)}</desc>{rest}'
    )
