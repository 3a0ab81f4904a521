"""A step as viewers draw it, one `foxglove.Grid` for each layer: belief and policy, the cells sensed, the target.

The view: a frame of coordinates in the middle of the interesting part of a large grid.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, TypeAlias

import numpy as np

from trackmdp.arrays.types import AnyArray, BoolArray
from trackmdp.episodes.episode import Episode, Floats
from trackmdp.episodes.schema import clock_of, json_bytes
from trackmdp.machine import check_free

WHOLE_CELLS = 64 * 64
"""Cells up to which belief and policy are written whole; of a larger grid, where either is more than 0."""

PART, _STEP = 25, 9
"""Rows and columns that a viewer shows of a larger grid, and how far that part moves at once: it stays where it is
while the target does not leave 9 x 9 cells."""

_EACH = 4 + 4 + 1
"""Bytes of belief, policy and action of a cell in a step."""
_AT_ONCE = 2**22
"""Numbers of a layer that are made together, of several steps."""

Box: TypeAlias = tuple[int, int, int, int]
"""Top, bottom, left and right, ends excluded."""

_CELL = np.dtype([("belief", "<f4"), ("policy", "<f4")])
ACTIVE, _TARGET = np.dtype([("active", "u1")]), np.dtype([("target", "u1")])
_TYPES = {np.dtype("<f4"): 7, np.dtype("u1"): 1}  # foxglove.NumericType


@cache
def _constant(cell: np.dtype[Any], side: float) -> bytes:
    """The constant fields of all messages of a layer of square cells, without the braces."""
    fields = (cell.fields or {}).items()
    said = {
        "frame_id": "grid",
        "cell_size": {"x": side, "y": side},
        "cell_stride": cell.itemsize,
        "fields": [
            {"name": name, "offset": offset, "type": _TYPES[kind]}
            for name, (kind, offset, *_) in fields
        ],
    }
    return json_bytes(said)[1:-1]


_DOT = np.array([[[1]], [[0]]], np.uint8).view(_TARGET)
"""The target's layer, a single cell; 0 once it has exited."""


def grid_messages(
    episode: Episode, size: tuple[int, int], first_tick: int, covered: BoolArray
) -> Iterator[dict[str, bytes]]:
    """Of each step topic -> message, a layer above the other in this order, and where viewers look.

    `covered` `[T, M]` are the cells that the sensors on see.
    """
    rows, columns = size
    exited = (episode.target == rows * columns).astype(int).tolist()
    at = np.stack(np.divmod(episode.target % (rows * columns), columns), axis=1).tolist()
    layers, parts = _layers(episode, size, covered), _parts(episode, size)
    for t, (cells, box, active, around) in enumerate(layers):
        stamp, (row, column), (y, x) = stamp_of(first_tick + t), at[t], parts[t]
        yield {
            "/grid": boxed(stamp, cells, box, 0),
            "/active": boxed(stamp, active, around, 0.01),
            # half as wide as its cell, so that the layers beneath it show: in column 3 from x = 3.25 to 3.75
            "/target": grid_text(
                stamp, _DOT[exited[t]], column + 0.25, rows - row - 0.75, 0.02, 0.5
            ),
            "/part": part_text(stamp, x, rows - y),
        }


def _layers(
    episode: Episode, size: tuple[int, int], covered: BoolArray
) -> Iterator[tuple[AnyArray, Box, AnyArray, Box]]:
    """Of each step belief and policy `[R, C]`, and the cells sensed, each with the box to be written."""
    # A few steps at a time: of all steps together they would take 12 bytes for each step and cell.
    each = max(1, _AT_ONCE // math.prod(size))
    for begin in range(0, len(episode), each):
        some = slice(begin, begin + each)
        sensed = covered[some].reshape(-1, *size)
        cells = np.zeros(sensed.shape, _CELL)
        cells["belief"] = episode.belief[some].reshape(cells.shape)
        cells["policy"] = episode.probability[some].reshape(cells.shape)
        used = (cells["belief"] > 0) | (cells["policy"] > 0) | (math.prod(size) <= WHOLE_CELLS)
        active = sensed.view(ACTIVE)
        yield from zip(cells, boxes_of(used), active, boxes_of(sensed), strict=True)


def stamp_of(tick: int) -> bytes:
    """The begin of a message of a tick."""
    return json_bytes({"timestamp": clock_of(tick)})[:-1]


def part_text(stamp: bytes, x: float, y: float) -> bytes:
    """The message of a view with its middle at (x, y)."""
    return (
        b'%s,"parent_frame_id":"grid","child_frame_id":"part","translation":{"x":%g,"y":%g,"z":0},'
        b'"rotation":{"x":0,"y":0,"z":0,"w":1}}'
    ) % (stamp, x, y)


def _parts(episode: Episode, size: tuple[int, int]) -> list[list[float]]:
    """Of each step the middle (y, x) of the part of the grid around the target, from the top left.

    After its exit, around its last place. Row 100 lies in the block of rows 99 to 107, and a part in its middle, at
    y = 103.5; rows 0 to 8 lie in the block of y = 12.5, since a part does not reach beyond the grid.
    """
    rows, columns = size
    before = np.concatenate([[episode.start], episode.target[:-1]])
    seen = np.where(episode.target == rows * columns, before, episode.target)
    middles = np.stack(np.divmod(seen, columns), axis=1) // _STEP * _STEP + _STEP / 2
    half = np.minimum(size, PART) / 2
    return np.clip(middles, half, np.array(size) - half).tolist()


def boxes_of(used: BoolArray) -> Iterator[Box]:
    """Of each step the smallest box around what is `used` `[T, R, C]`.

    Where nothing is, the first cell.
    """
    ends = []
    for axis in (2, 1):
        lines: BoolArray = np.any(used, axis)  # [T, R], then [T, C]
        some: BoolArray = np.any(lines, 1)
        # argmax is the place of the first True: lines 0 1 1 0 0 begin at 1 and, 0 0 1 1 0 backwards, end at 5 - 2 = 3
        ends += [lines.argmax(1), np.where(some, lines.shape[1] - lines[:, ::-1].argmax(1), 1)]
    return zip(*(each.tolist() for each in ends), strict=True)


def boxed(stamp: bytes, cells: AnyArray, box: Box, z: float) -> bytes:
    """The message of the part `box` of a layer `[R, C]`."""
    top, bottom, left, right = box
    return grid_text(stamp, cells[top:bottom, left:right], left, len(cells) - bottom, z)


def grid_text(
    stamp: bytes, cells: AnyArray, x: float, y: float, z: float, side: float = 1
) -> bytes:
    """The message of `cells` `[R, C]` of this side with the lowest left corner at (x, y, z)."""
    columns, stride = cells.shape[1], cells.dtype.itemsize
    # turned upside down, since a viewer's first row is the lowest
    data = base64.b64encode(cells[::-1].tobytes())
    return (
        b'%s,"pose":{"position":{"x":%g,"y":%g,"z":%g},"orientation":{"x":0,"y":0,"z":0,"w":1}},'
        b'"column_count":%d,"row_stride":%d,%s,"data":"%s"}'
    ) % (stamp, x, y, z, columns, columns * stride, _constant(cells.dtype, side), data)


def read_grids(grids: Sequence[bytes], size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Belief and policy `[T, M]` of the `/grid` messages of an episode.

    Raises:
        ValueError, KeyError, TypeError: one is none of a grid of `size`.
    """
    rows, columns = size
    check_layers(len(grids), rows * columns)
    # zeros and not one block: only written parts take memory, however many steps a log claims
    belief, policy = (np.zeros((len(grids), rows, columns), np.float32) for _ in range(2))
    for t, text in enumerate(grids):
        place, cells = read_grid(text, size, _CELL)
        belief[t][place], policy[t][place] = cells["belief"], cells["policy"]
    return belief.reshape(len(grids), -1), policy.reshape(len(grids), -1)


def check_layers(steps: int, cells: int) -> None:
    """See that belief, policy and action of an episode fit into free memory.

    Raises:
        UserError: they do not fit.
    """
    check_free(f"an episode of {steps:,} steps on {cells:,} cells", _EACH * steps * cells)


def read_grid(
    text: bytes, size: tuple[int, int], cell: np.dtype[Any]
) -> tuple[tuple[slice, slice], AnyArray]:
    """The part of the grid that a message is of, and what it says of its cells.

    Raises:
        ValueError, KeyError, TypeError: it is none of a grid of `size`.
    """
    (rows, columns), said = size, json.loads(text)
    left = said["pose"]["position"]["x"]
    low = said["pose"]["position"]["y"]
    width = said["column_count"]
    cells = np.frombuffer(base64.b64decode(said["data"], validate=True), cell).reshape(-1, width)
    top, bottom = rows - low - len(cells), rows - low
    if not (0 <= top < bottom <= rows and left >= 0 and left + width <= columns):
        raise ValueError("a grid that lies outside")
    return (slice(top, bottom), slice(left, left + width)), cells[::-1]
