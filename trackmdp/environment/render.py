"""A grid, the sensors that are on and the target, as text or as pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from trackmdp.arrays.types import BoolArray, IndexArray

FOUND, MISSED, ON, OFF = "●", "○", "▪", "·"
PICTURE_LEGEND = (
    f"{FOUND} target, detected   {MISSED} target, missed   {ON} sensor on   {OFF} sensor off"
)
NUMBERED = "⓿❶❷❸❹❺❻❼❽❾", "⓪①②③④⑤⑥⑦⑧⑨"
"""The first of several targets, located and missed; after the tenth all are `FOUND` and `MISSED`."""
FOUND_OF_SEVERAL = f"{NUMBERED[0][:2]} targets 0 and 1, located", f"{NUMBERED[1][:2]} missed"
LEGEND_OF_SEVERAL = "   ".join([*FOUND_OF_SEVERAL, f"{ON} sensor on", f"{OFF} sensor off"])

# Red, green, blue; distinct in grey as well, and without red.
_COLOURS = {
    FOUND + NUMBERED[0]: (0, 90, 181),
    MISSED + NUMBERED[1]: (220, 50, 32),
    ON: (255, 194, 10),
    OFF: (238, 238, 238),
}
_SIDE, _GAP = 16, 1  # pixels of a cell, and of the white line around it


def symbols(
    size: Sequence[int], cell: Any, on: BoolArray, *, found: Any, empty: Any = OFF
) -> npt.NDArray[np.str_]:
    """`[rows, columns]` symbols, `empty` where no sensor is on; the target's cell M, exited, is on no grid.

    Of several targets, `cell` and `found` `[K]`; of those in the same cell the first is shown.
    """
    marks, cells = np.where(on, ON, empty), np.atleast_1d(cell)
    shown = zip(range(len(cells)), cells, np.atleast_1d(found), strict=True)
    for target, place, seen in reversed([each for each in shown if each[1] < len(marks)]):
        numbers, plain = (NUMBERED[0], FOUND) if seen else (NUMBERED[1], MISSED)
        marks[place] = numbers[target] if len(cells) > 1 and target < len(numbers) else plain
    return marks.reshape(tuple(size))


def around(place: int, length: int, wide: int) -> range:
    """The rows, or columns, that are drawn of a large grid: `wide` of `length`, as near around `place` as they can be.

    Place 4 of 40, 21 wide, gives 0 to 20; place 15 gives 5 to 25.
    """
    begin = min(max(place - wide // 2, 0), max(length - wide, 0))
    return range(begin, min(begin + wide, length))


def picture(
    mode: str, size: Sequence[int], cell: IndexArray, on: BoolArray, *, found: BoolArray
) -> npt.NDArray[np.uint8] | str:
    """The grid as pixels or as text.

    Args:
        mode: "rgb_array" for red, green and blue `[16 rows, 16 columns, 3]`, else a line of symbols for each row, and
            their legend.
        size: rows and columns.
        cell: the target's, M where it has exited; of several targets `[K]`, as for `found`.
        on: `[M]` sensors that are on.
        found: whether the target is detected.
    """
    marks = symbols(size, cell, on, found=found)
    if mode != "rgb_array":
        legend = PICTURE_LEGEND if cell.size == 1 else LEGEND_OF_SEVERAL
        return "\n".join([*(" ".join(row) for row in marks), legend])
    pixels = np.full((*marks.shape, _SIDE, _SIDE, 3), 255, np.uint8)
    for alike, colour in _COLOURS.items():
        here = np.isin(marks, list(alike))
        # A boolean index picks whole tiles, [hits, side, side, 3], and their inner part gets the colour.
        tiles = pixels[here]
        tiles[:, _GAP:-_GAP, _GAP:-_GAP] = colour
        pixels[here] = tiles
    # [rows, columns, y, x, 3] to [rows, y, columns, x, 3]: neighbouring tiles' lines of pixels side by side.
    rows, columns = marks.shape
    return pixels.transpose(0, 2, 1, 3, 4).reshape(rows * _SIDE, columns * _SIDE, 3)
