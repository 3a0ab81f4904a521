"""One table, three forms: HTML that sorts, CSV to the last digit, LaTeX to be pasted.

The paragraphs of reports stand in text files: a line with what each is called, then the paragraph itself.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, TypeAlias

from trackmdp.durable import csv_text
from trackmdp.untrusted import no_formula, printable


@cache
def paragraphs(package: str, file: str = "prose.txt") -> dict[str, str]:
    """Name -> paragraph of a text file in a package; what stands in braces is filled in by `str.format`."""
    text = files(package).joinpath(file).read_text(encoding="utf-8")
    return {name: " ".join(lines) for name, *lines in map(str.splitlines, text.split("\n\n"))}


Cell: TypeAlias = "float | int | str | bool | None"

LONG = 60
"""A cell of more characters than this may be broken over lines."""
_LATEX = {letter: f"\\{letter}" for letter in "{}$&%#_"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}"}
_LATEX |= {"^": r"\textasciicircum{}", "≤": r"$\le$", "±": r"$\pm$", "–": "--", "²": "$^2$"}


@dataclass(frozen=True)
class Column:
    """Heading, unit and format of a column.

    Attributes:
        label: heading.
        digits: decimals of a number; None for as they are.
        unit: shown in the heading.
    """

    label: str
    digits: int | None = None
    unit: str = ""

    @property
    def heading(self) -> str:
        """Label and unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    def text(self, value: Cell) -> str:
        """A cell as it is shown."""
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return "–"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, str):
            return printable(value)
        if self.digits is None:
            return f"{value:,}" if isinstance(value, int) else f"{value:g}"
        # -0.0004 with three digits is "-0.000": shown as 0.000, since the sign of a rounding error is no result. The
        # minus is the typographic one, as in the figures.
        shown = f"{value:,.{self.digits}f}"
        zero = f"{0.0:,.{self.digits}f}"
        return zero if shown.lstrip("+-") == zero else shown.replace("-", "−")


@dataclass(frozen=True)
class Table:
    """Rows under columns; `name` is that of its files, `caption` says what it shows, with n.

    On a page one with a text in `folded` shows when that is pressed.
    """

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    folded: str = ""

    def csv(self) -> str:
        """All digits; an empty field where there is nothing."""
        return csv_text([column.heading for column in self.columns], (map(_plain, row) for row in self.rows))

    def latex(self) -> str:
        """A `tabular` with horizontal rules; it needs no package."""
        # Words to the left, numbers to the right, as their digits are compared from the right.
        align = "".join("l" if self._is_text(place) else "r" for place in range(len(self.columns)))
        head = " & ".join(rf"\textbf{{{_escape(column.heading)}}}" for column in self.columns)
        body = [" & ".join(_escape(c.text(v)) for c, v in zip(self.columns, row, strict=True)) for row in self.rows]
        # In one line: what follows a line break would no longer be a comment.
        above = [f"% {' '.join(self.caption.split())}", rf"\begin{{tabular}}{{{align}}}"]
        lines = [r"\hline", rf"{head} \\", r"\hline", *(rf"{line} \\" for line in body), r"\hline"]
        return "\n".join([*above, *lines, r"\end{tabular}", ""])

    def html(self) -> str:
        """A table whose columns sort when their heading's button is pressed."""
        heads = "".join(
            f'<th scope="col"{self._side(place)}><button type="button">{html.escape(column.heading)}</button></th>'
            for place, column in enumerate(self.columns)
        )
        rows = "\n".join(f"<tr>{self._cells(row)}</tr>" for row in self.rows)
        caption = html.escape(self.caption)
        shown = (
            # A wide table scrolls within its own box; `tabindex` lets the keyboard scroll it too.
            f'<div class="scroll" tabindex="0" role="region" aria-label="{caption}"><table class="sortable">'
            f"<caption>{caption}</caption><thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
        )
        return f"<details><summary>{html.escape(self.folded)}</summary>{shown}</details>" if self.folded else shown

    def _cells(self, row: Sequence[Cell]) -> str:
        cells = []
        for place, (column, value) in enumerate(zip(self.columns, row, strict=True)):
            text = html.escape(column.text(value))
            mark = ' class="wide"' if len(text) > LONG else ""
            number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
            # The page sorts by the full number; the text of the cell is rounded and has separators.
            sort = f' data-v="{value!r}"' if number else ""
            cells.append(f"<td{mark or self._side(place)}{sort}>{text}</td>")
        return "".join(cells)

    def _side(self, place: int) -> str:
        return "" if self._is_text(place) else ' class="n"'

    def _is_text(self, place: int) -> bool:
        return self._texts[place]

    @cached_property
    def _texts(self) -> list[bool]:
        """Whether each column is one of words; made once, as every cell asks."""
        known = [[row[place] for row in self.rows if row[place] is not None] for place in range(len(self.columns))]
        # a column in which nothing is known stands as its numbers would
        return [bool(values) and all(isinstance(value, (str, bool)) for value in values) for values in known]


def _plain(value: Cell) -> Any:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, str):
        return no_formula(printable(value))
    return repr(value) if isinstance(value, float) else value


def _escape(text: str) -> str:
    # letter by letter: what stands for one is not looked at again
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))
