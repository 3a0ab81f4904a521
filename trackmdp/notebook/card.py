"""The card of an object: its name and its main figures, as `repr` shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from trackmdp.errors import UserError
from trackmdp.notebook.pictures import picture_of
from trackmdp.untrusted import printable

MOST_LINES, WIDE = 12, 100
"""Lines of a card, and letters of a line, at most."""

NONE = "–"
"""Stands for a figure that is not known."""

Facts: TypeAlias = dict[str, str]
"""Name of a figure -> its value, in the order of the card."""


@dataclass(frozen=True)
class Card:
    """Title and figures of an object.

    Attributes:
        title: in one line.
        facts: at most `MOST_LINES - 1` of them are shown.
    """

    title: str
    facts: Facts

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of the figures that are shown."""
        return list(self.facts.items())[: MOST_LINES - 1]

    def text(self) -> str:
        """The card as lines, names to the left of their values."""
        rows = self.rows()
        # Two blanks before a name and two after the longest one: four letters of a line.
        width = max((len(name) for name, _ in rows), default=0)
        lines = [clipped(self.title, WIDE)]
        lines += [f"  {name:<{width}}  {clipped(value, WIDE - width - 4)}" for name, value in rows]
        return "\n".join(lines)


class Carded:
    """Base of the classes of objects with a card."""

    def card(self) -> Card:
        """Title and main figures; `repr` is its text."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.card().text()

    def _repr_html_(self) -> str:
        from trackmdp.notebook.drawing import page_of

        card = self.card()
        return page_of(card.title, card.rows(), picture_of(self))

    def plot(self, axes: Any = None) -> Any:
        """Draw the object's picture on matplotlib axes, by default on new ones, and return them.

        Raises:
            UserError: there is no picture of it, or matplotlib is not installed (extra `report`).
        """
        from trackmdp.notebook.drawing import draw

        picture = picture_of(self)
        if picture is None:
            raise UserError(f"plot: no picture of this {type(self).__name__}")
        return draw(picture, axes)


def clipped(text: str, most: int) -> str:
    """`text` in one line of at most so many letters; of a longer one both ends are kept, as a path needs them."""
    line = printable(" ".join(text.split()))
    if len(line) <= most:
        return line
    # Ten letters in five: "ab…ij", two before the sign and two after it.
    head = (most - 1) // 2
    return f"{line[:head]}…{line[len(line) - (most - 1 - head) :]}"


def decimal(value: float | None, digits: int = 3) -> str:
    """A number with thousands set apart; a dash where there is none."""
    if value is None or math.isnan(value):
        return NONE
    return f"{round(value, digits) + 0.0:,.{digits}f}"  # -0.0 + 0.0 is 0.0


def percent(share: float | None) -> str:
    """A share as a percentage; a dash where there is none."""
    return NONE if share is None or math.isnan(share) else f"{100 * share:.2f} %"


def span(low: float, high: float) -> str:
    """A range of numbers; one number where its ends are the same."""
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def counted_words(count: int, unit: str, more: str = "") -> str:
    """A number of units, such as `1 group of tracks` and `2 groups of tracks`; `more` follows the unit."""
    return f"{count:,} {unit}{'' if count == 1 else 's'}{more}"


def grid_words(size: Sequence[int]) -> str:
    """The size of a grid in words, such as `6 x 9 cells`."""
    return f"{size[0]} x {size[1]} cells"
