"""A step as viewers draw it, one `foxglove.Grid` for each layer: belief and policy, the cells sensed, the target.

The view: a frame of coordinates in the middle of the interesting part of a large grid.

A layout for viewers that take Lichtblick's form: maps in layers, plots of the steps, where targets were located.

`layout.json` is an export of the viewers: two maps of three layers each (a field of `/grid`, over it the cells sensed,
except on the policy's map, over those the target) with cameras that follow `/part`, the plots, and the last
`/episode`.
The lines of a plot are named by their colours in its title: a legend would lie over them.
Of the times that Foxglove knows, Lichtblick draws lines for `receiveTime` alone, and it shows nothing of a layout
without a speed: a step takes 0.1 s of the log, at 0.2 half a second.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from trackmdp.durable import write_text
from trackmdp.episodes.episode import Episode, Floats
from trackmdp.episodes.schema import time_of
from trackmdp.world.model import BoolArray

WHOLE_CELLS = 64 * 64
"""Cells up to which belief and policy are written whole; of a larger grid, where either is more than 0."""

PART, _STEP = 25, 9
"""Rows and columns that a viewer shows of a larger grid, and how far that part moves at once: it stays where it is
while the target does not leave 9 x 9 cells."""

_CELL = np.dtype([("belief", "<f4"), ("policy", "<f4")])
_ACTIVE, _TARGET = np.dtype([("active", "u1")]), np.dtype([("target", "u1")])
_TYPES = {np.dtype("<f4"): 7, np.dtype("u1"): 1}  # foxglove.NumericType


def _constant(cell: np.dtype[Any], side: float = 1) -> bytes:
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
    return json.dumps(said, separators=(",", ":")).encode()[1:-1]


_GRID_SAYS, _ACTIVE_SAYS, _TARGET_SAYS = (
    _constant(_CELL),
    _constant(_ACTIVE),
    _constant(_TARGET, side=0.5),
)

_DOT = np.array([[[1]], [[0]]], np.uint8)
"""The target's layer, a single cell; 0 once it has exited."""


def grid_messages(
    episode: Episode, size: tuple[int, int], first_tick: int, covered: BoolArray | None = None
) -> Iterator[dict[str, bytes]]:
    """Of each step topic -> message, a layer above the other in this order, and where viewers look.

    `covered` `[T, M]` are the cells that the sensors on see; None where each sees its own.
    """
    rows, columns = size
    cells = np.zeros((len(episode), rows, columns), _CELL)
    cells["belief"] = np.asarray(episode.belief).reshape(cells.shape)
    cells["policy"] = np.asarray(episode.probability).reshape(cells.shape)
    active = (episode.action if covered is None else covered).reshape(cells.shape)
    whole = np.broadcast_to(True, cells.shape)
    used = whole if rows * columns <= WHOLE_CELLS else (cells["belief"] > 0) | (cells["policy"] > 0)
    sensed = active.view(np.uint8)
    exited = (episode.target == rows * columns).astype(int).tolist()
    at = np.stack(np.divmod(episode.target % (rows * columns), columns), axis=1).tolist()
    boxes = zip(_boxes(used), _boxes(active), at, _parts(episode, size), strict=True)
    for t, (
        (top, bottom, left, right),
        (first, last, start, stop),
        (row, column),
        (y, x),
    ) in enumerate(boxes):
        seconds, rest = divmod(time_of(first_tick + t), 1_000_000_000)
        stamp = b'{"timestamp":{"sec":%d,"nsec":%d}' % (seconds, rest)
        yield {
            "/grid": _grid(
                stamp, _GRID_SAYS, cells[t, top:bottom, left:right], left, rows - bottom, 0
            ),
            "/active": _grid(
                stamp, _ACTIVE_SAYS, sensed[t, first:last, start:stop], start, rows - last, 0.01
            ),
            # half as wide as its cell, so that the layers beneath it show: in column 3 from x = 3.25 to 3.75
            "/target": _grid(
                stamp, _TARGET_SAYS, _DOT[exited[t]], column + 0.25, rows - row - 0.75, 0.02
            ),
            "/part": (
                b'%s,"parent_frame_id":"grid","child_frame_id":"part","translation":{"x":%g,"y":%g,"z":0},'
                b'"rotation":{"x":0,"y":0,"z":0,"w":1}}'
            )
            % (stamp, x, rows - y),
        }


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


def _boxes(used: BoolArray) -> Iterator[tuple[int, int, int, int]]:
    """Of each step the smallest (top, bottom, left, right), ends excluded, around what is `used` `[T, R, C]`.

    Where nothing is, the first cell.
    """
    ends = []
    for axis in (2, 1):
        lines: BoolArray = np.any(used, axis)  # [T, R], then [T, C]
        some: BoolArray = np.any(lines, 1)
        # argmax is the place of the first True: lines 0 1 1 0 0 begin at 1 and, 0 0 1 1 0 backwards, end at 5 - 2 = 3
        ends += [lines.argmax(1), np.where(some, lines.shape[1] - lines[:, ::-1].argmax(1), 1)]
    return zip(*(each.tolist() for each in ends), strict=True)


def _grid(
    stamp: bytes, says: bytes, cells: npt.NDArray[Any], x: float, y: float, z: float
) -> bytes:
    """The message of `cells` `[R, C]` with the lowest left corner at (x, y, z)."""
    columns, stride = cells.shape[1], cells.dtype.itemsize
    # turned upside down, since a viewer's first row is the lowest
    data = base64.b64encode(cells[::-1].tobytes())
    return (
        b'%s,"pose":{"position":{"x":%g,"y":%g,"z":%g},"orientation":{"x":0,"y":0,"z":0,"w":1}},'
        b'"column_count":%d,"row_stride":%d,%s,"data":"%s"}'
    ) % (stamp, x, y, z, columns, columns * stride, says, data)


def read_grids(grids: Sequence[bytes], size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Belief and policy `[T, M]` of the `/grid` messages of an episode.

    Raises:
        ValueError, KeyError, TypeError: one is none of a grid of `size`.
    """
    rows, columns = size
    # zeros and not one block: only written parts take memory, however many steps a log claims
    belief, policy = (np.zeros((len(grids), rows, columns), np.float32) for _ in range(2))
    for t, text in enumerate(grids):
        said = json.loads(text)
        left, low, width = (
            said["pose"]["position"]["x"],
            said["pose"]["position"]["y"],
            said["column_count"],
        )
        cells = np.frombuffer(base64.b64decode(said["data"], validate=True), _CELL).reshape(
            -1, width
        )[::-1]
        top, bottom = rows - low - len(cells), rows - low
        if not (0 <= top < bottom <= rows and left >= 0 and left + width <= columns):
            raise ValueError("a grid that lies outside")
        belief[t, top:bottom, left : left + width] = cells["belief"]
        policy[t, top:bottom, left : left + width] = cells["policy"]
    return belief.reshape(len(grids), -1), policy.reshape(len(grids), -1)


def layout(size: tuple[int, int]) -> dict[str, Any]:
    """The layout as plain values, for a grid of `size` (rows, columns)."""
    made: dict[str, Any] = json.loads(
        files("trackmdp.episodes").joinpath("layout.json").read_text(encoding="utf-8")
    )
    for panel in made["configById"].values():
        if "cameraState" in panel:
            # Without perspective the distance is the height of the view, in cells: the part and a margin.
            panel["cameraState"]["distance"] = 1.2 * min(max(size), PART)
            panel["layers"] = {f"lines {place}": each for place, each in enumerate(_lines(size))}
    return made


def _lines(size: tuple[int, int]) -> list[dict[str, Any]]:
    """Lines around all cells, over the belief and under the sensors.

    Viewers draw them as squares only: a grid of 4 x 6 cells has two of side 4 over each other, from columns 0 and 2.
    """
    side = min(size)
    count = -(-max(size) // side)
    # from the first to the last place that the square has along either side
    corners = (np.linspace([0, 0], np.array(size) - side, count).round() + side / 2).tolist()
    same = {
        "layerId": "foxglove.Grid",
        "visible": True,
        "frameId": "grid",
        "size": side,
        "divisions": side,
    }
    same |= {"lineWidth": 1, "color": "#80808080"}
    return [same | {"position": [x, y, 0.005]} for y, x in corners]


def write_layout(file: Path, size: tuple[int, int]) -> None:
    """Write the layout as JSON."""
    write_text(file, json.dumps(layout(size), indent=2) + "\n")
