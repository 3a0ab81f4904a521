"""Colours of several targets, told apart by number; the same on the page, in a video and in viewers."""

from __future__ import annotations

COLOURS = ("#0072b2", "#c2185b", "#00694f", "#6a3d9a", "#8a7000", "#0a8f8f", "#7a4a2b", "#5c5c5c")
"""After the last one they begin again; the number beside a target distinguishes it then."""


def colour_of(target: int) -> str:
    """The colour of a target, as `#rrggbb`."""
    return COLOURS[target % len(COLOURS)]


def shares_of(target: int) -> dict[str, float]:
    """The same as shares of red, green and blue, 0 to 1, called r, g and b."""
    places = zip("rgb", bytes.fromhex(colour_of(target)[1:]), strict=True)
    return {name: round(each / 255, 3) for name, each in places}
