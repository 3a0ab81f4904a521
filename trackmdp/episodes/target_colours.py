"""Colours of several targets, told apart by number; the same on the page, in a video and in viewers."""

from __future__ import annotations

COLOURS = ("#0072b2", "#c2185b", "#00694f", "#6a3d9a", "#8a7000", "#0a8f8f", "#7a4a2b", "#5c5c5c")
"""After the last one they begin again; the number beside a target distinguishes it then."""


def colour_of(target: int) -> str:
    """The colour of a target, as `#rrggbb`."""
    return COLOURS[target % len(COLOURS)]


def shares_of(target: int) -> tuple[float, float, float]:
    """The same as shares of red, green and blue, 0 to 1."""
    code = colour_of(target)
    red, green, blue = (round(int(code[at : at + 2], 16) / 255, 3) for at in (1, 3, 5))
    return red, green, blue
