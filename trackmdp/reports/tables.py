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
        align = "".join("l" if words else "r" for _, _, words in self._shown)
        heads = (rf"\textbf{{{_escape(column.heading)}}}" for _, column, _ in self._shown)
        body = [
            " & ".join(_escape(column.text(row[place])) for place, column, _ in self._shown)
            for row in self.rows
        ]
        # In one line: the rest after a line break would be no comment.
        above = [f"% {' '.join(self.caption.split())}", rf"\begin{{tabular}}{{{align}}}"]
        lines = [
            r"\hline",
            rf"{' & '.join(heads)} \\",
            r"\hline",
            *(rf"{line} \\" for line in body),
            r"\hline",
        ]
        return "\n".join([*above, *lines, r"\end{tabular}", ""])

    def html(self) -> str:
        """A table with columns that sort when their heading is pressed."""
        heads = "".join(
            f'<th scope="col"{_side(words)}><button type="button">'
            f"{html.escape(column.heading)}</button></th>"
            for _, column, words in self._shown
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
        for place, column, words in self._shown:
            value, text = row[place], html.escape(column.text(row[place]))
            number = isinstance(value, (int, float)) and not words and is_known(value)
            # The page sorts by the full number; the text is rounded and has separators.
            sort = f' data-v="{value!r}"' if number else ""
            cells.append(f"<td{_side(words)}{sort}>{text}</td>")
        return "".join(cells)

    @cached_property
    def _shown(self) -> list[tuple[int, Column, bool]]:
        """Place, column and whether it is one of words, of the columns with a value; of all where there are no rows."""
        shown = []
        for place, column in enumerate(self.columns):
            known = [row[place] for row in self.rows if is_known(row[place])]
            if known or not self.rows:
                words = all(isinstance(value, (str, bool)) for value in known)
                shown.append((place, column, words))
        return shown


def _side(words: bool) -> str:
    return "" if words else ' class="n"'


def _plain(value: Cell) -> Any:
    if not is_known(value):
        return ""
    if isinstance(value, str):
        return no_formula(printable(value))
    return repr(value) if isinstance(value, float) else value


def _escape(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))
