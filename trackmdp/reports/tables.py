"""One table, three forms: HTML that sorts, CSV to the last digit, LaTeX to be pasted. Paragraphs from text files."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, TypeAlias

from trackmdp.durable import csv_text
from trackmdp.untrusted import no_formula, printable

Cell: TypeAlias = float | int | str | bool | None
Rows: TypeAlias = list[list[Cell]]

_LATEX = {letter: f"\\{letter}" for letter in "{}$&%#_"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
}
_LATEX |= {"^": r"\textasciicircum{}", "≤": r"$\le$", "±": r"$\pm$", "–": "--", "²": "$^2$"}
# In LaTeX's default encoding these letters are others, < is an exclamation mark on its head.
_LATEX |= {letter: f"${letter}$" for letter in "<>|"}
# At the beginning of a row they would belong to the line break above.
_LATEX |= {letter: f"{{{letter}}}" for letter in "[*"}


@cache
def paragraphs(package: str, file: str = "prose.txt") -> dict[str, str]:
    """Name -> paragraph of a text file in a package: a line with the name, then the text; braces as in `str.format`."""
    text = files(package).joinpath(file).read_text(encoding="utf-8")
    return {name: " ".join(lines) for name, *lines in map(str.splitlines, text.split("\n\n"))}


def is_known(value: Cell) -> bool:
    """Whether a cell has a value."""
    return value is not None and value == value  # nan differs from itself


@dataclass(frozen=True)
class Column:
    """Heading, unit and format of a column.

    Attributes:
        label: heading.
        digits: decimals of a number; None: as many as it has.
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
        if value is None or not is_known(value):
            return "–"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, str):
            return printable(value)
        if self.digits is None:
            return f"{value:,}" if isinstance(value, int) else f"{value:g}"
        # The sign of a rounding error, as in -0.000, is no result.
        shown, zero = f"{value:,.{self.digits}f}", f"{0.0:.{self.digits}f}"
        return zero if shown.lstrip("-") == zero else shown.replace("-", "−")


def interval_columns(digits: int | None, head: str = "") -> list[Column]:
    """Columns for the ends of an interval."""
    return [Column(f"{head}95 % from", digits), Column(f"{head}to", digits)]


@dataclass(frozen=True)
class Table:
    """Rows under columns.

    Attributes:
        name: of its files.
        caption: content, with n.
        columns, rows: a cell of each row for each column. Columns without any value are in the CSV file only.
        folded: on a page, the text to press before the table is shown.
    """

    name: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    folded: str = ""

    def csv(self) -> str:
        """All digits; an empty field for no value."""
        heads = [column.heading for column in self.columns]
        return csv_text(heads, (map(_plain, row) for row in self.rows))

    def latex(self) -> str:
        """A `tabular` with horizontal rules; it needs no package."""
        columns = [self.columns[place] for place in self._shown]
        align = "".join("l" if self._texts[place] else "r" for place in self._shown)
        head = " & ".join(rf"\textbf{{{_escape(column.heading)}}}" for column in columns)
        body = [
            " & ".join(_escape(self.columns[place].text(row[place])) for place in self._shown)
            for row in self.rows
        ]
        # In one line: the rest after a line break would be no comment.
        above = [f"% {' '.join(self.caption.split())}", rf"\begin{{tabular}}{{{align}}}"]
        lines = [r"\hline", rf"{head} \\", r"\hline", *(rf"{line} \\" for line in body), r"\hline"]
        return "\n".join([*above, *lines, r"\end{tabular}", ""])

    def html(self) -> str:
        """A table with columns that sort when their heading is pressed."""
        heads = "".join(
            f'<th scope="col"{self._side(place)}><button type="button">'
            f"{html.escape(self.columns[place].heading)}</button></th>"
            for place in self._shown
        )
        rows = "\n".join(f"<tr>{self._cells(row)}</tr>" for row in self.rows)
        caption = html.escape(self.caption)
        # A wide table scrolls within its own box; `tabindex` lets the keyboard scroll it too.
        shown = (
            f'<div class="scroll" tabindex="0" role="region" aria-label="{caption}"><table class="sortable">'
            f"<caption>{caption}</caption><thead><tr>{heads}</tr></thead>\n<tbody>{rows}</tbody></table></div>"
        )
        if not self.folded:
            return shown
        return f"<details><summary>{html.escape(self.folded)}</summary>{shown}</details>"

    def _cells(self, row: Sequence[Cell]) -> str:
        cells = []
        for place in self._shown:
            value, text = row[place], html.escape(self.columns[place].text(row[place]))
            number = isinstance(value, (int, float)) and not self._texts[place] and is_known(value)
            # The page sorts by the full number; the text is rounded and has separators.
            sort = f' data-v="{value!r}"' if number else ""
            cells.append(f"<td{self._side(place)}{sort}>{text}</td>")
        return "".join(cells)

    def _side(self, place: int) -> str:
        return "" if self._texts[place] else ' class="n"'

    @cached_property
    def _known(self) -> list[list[Cell]]:
        """Values of each column; made once, as every cell asks."""
        places = range(len(self.columns))
        return [[row[place] for row in self.rows if is_known(row[place])] for place in places]

    @cached_property
    def _shown(self) -> list[int]:
        """Places of the columns with a value; of all columns where there are no rows."""
        return [place for place, values in enumerate(self._known) if values or not self.rows]

    @cached_property
    def _texts(self) -> list[bool]:
        """Whether each column is one of words."""
        return [all(isinstance(value, (str, bool)) for value in values) for values in self._known]


def _plain(value: Cell) -> Any:
    if not is_known(value):
        return ""
    if isinstance(value, str):
        return no_formula(printable(value))
    return repr(value) if isinstance(value, float) else value


def _escape(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))
