"""From recorded positions to tracks of cells: projected, sampled at a fixed step, cut at gaps and where they leave."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from trackmdp.arrays.entries import ends_of, ranks
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.grid.place import Place, projected, projection
from trackmdp.notebook.card import counted_words
from trackmdp.recordings.positions import Positions
from trackmdp.recordings.tracks import Tracks

_WIDEST = 12.0
"""Degrees of longitude that one UTM zone, six degrees wide, is stretched over at most."""

_TORN = 1e7
"""Metres of a step over 180 degrees that is one around the world; a projection that is whole there has far less."""

_MOST = 2**27
"""Steps of all tracks together; times in milliseconds and a step in seconds would make thousands for each report."""

_OUTSIDE = "steps outside of the grid"

_PARTS = 50
"""Of a cell. A city is a tenth of a degree wide, its cells tens of metres; a continent tens, its cells kilometres."""


@dataclass(frozen=True)
class Gridding:
    """How positions become cells.

    Attributes:
        size: rows and columns of the grid; row 0 is the upper one, in the north.
        cell: side of a cell, metres (of videos pixels).
        step: time from one cell of a track to the next, seconds (of videos frames).
        max_gap: longest time between two reports that is bridged, by a straight line; seconds.
        shortest: fewest cells of a track.
        exits: whether a target has left the grid at its last report.
        origin: the corner of the grid with the smallest coordinates, in the file's coordinates; None: grid and
            positions that are not held out have the same middle.
        crs: projected coordinate system for degrees, such as ``EPSG:2056``; None: the UTM zone of their median.
    """

    size: tuple[int, int]
    cell: float
    step: float
    max_gap: float
    shortest: int
    exits: bool
    origin: tuple[float, float] | None = None
    crs: str | None = None


def to_tracks(
    positions: Positions, grid: Gridding, source: str, held_out: np.ndarray
) -> tuple[Tracks, dict[str, int], Place]:
    """The tracks, the counts of reports read, cut or dropped, and the place of the grid.

    A path is cut where no report came for longer than `max_gap`, and where it is outside of the grid. Its pieces are
    tracks of the same name; one that ends by leaving the grid has an exit.

    Args:
        positions: of all targets.
        grid: size, cells and steps of the tracks.
        source: begins a message.
        held_out: targets that have no say in where the grid lies, since nothing is learned from them.

    Raises:
        UserError: the projection does not fit the positions, or no track is left.
    """
    flat, place = _placed(positions, grid, source, ~np.isin(positions.track, held_out))
    wide, high = np.ptp(_spread(flat.x, flat.y), axis=1).tolist()
    # 0: nothing moves
    if not positions.geographic and 0 < max(wide, high) < grid.cell / _PARTS:
        raise UserError(
            f"{source}: nearly all positions lie within {wide:.3g} x {high:.3g}, far less than a cell "
            f"(grid.cell={grid.cell:g}); expected a smaller cell, or columns lat and lon for degrees"
        )
    begin, x, y, last = _sampled(flat, grid)
    cells = place.cells(x, y, grid.size)
    tracks, counts = _cut(cells, begin, last, flat, grid)
    gaps = int(_breaks(flat, grid).sum()) - len(np.unique(flat.track))
    gap = f"{grid.max_gap:g} {'frames' if positions.downwards else 's'}"
    report = {
        "reports read": positions.read,
        "targets": len(np.unique(flat.track)),
        **positions.dropped,
        f"cuts where no report came for {gap} or the file has a break": gaps,
        "steps": len(cells),
        **counts,
    }
    # The grid.size that would do, where the default was forgotten; none where the projection reaches no position.
    if counts[_OUTSIDE] and math.isfinite(max(wide, high) / grid.cell):
        columns, rows = (max(1, math.ceil(each / grid.cell)) for each in (wide, high))
        report |= {"rows that nearly all positions span": rows, "columns that they span": columns}
    if not len(tracks):
        raise UserError(f"{source}: no track of at least {grid.shortest} cells; {said(report)}")
    return tracks, report, place


def _spread(x: Array, y: Array) -> Array:
    """`[2, 2]` 1st and 99th percentile of x and of y, between which nearly all positions lie; nan without any."""
    known = (column[np.isfinite(column)] for column in (x, y))
    return np.array([np.percentile(each, (1, 99)) if len(each) else [np.nan] * 2 for each in known])


def said(report: Mapping[str, int]) -> str:
    """The report in one line, without the counts of 0."""
    return ", ".join(f"{count:,} {what}" for what, count in report.items() if count)


def _placed(
    positions: Positions, grid: Gridding, source: str, says: np.ndarray
) -> tuple[Positions, Place]:
    """The positions in metres, and the place of the grid, which those in `says` `[P]` decide."""
    code, flat = None, positions
    if positions.geographic:
        code = grid.crs or _utm(positions.x[says], positions.y[says], source)
        x, y = map(np.asarray, projection(code).transform(positions.x, positions.y))
        # inf where the projection does not reach
        flat = replace(positions, x=x, y=y, piece=positions.piece + _seams(positions.x, x, y))
    elif grid.crs is not None:
        raise UserError(
            f"{source}: has x and y, which are not projected; grid.crs={grid.crs} is for lat and lon"
        )
    if grid.origin is not None:
        return flat, Place(projected(code, grid.origin), grid.cell, code, positions.downwards)
    # Grid and positions have the same middle: half way between the 1st and the 99th percentile, so that a few reports
    # from nowhere do not move the grid. Without any position it may lie anywhere.
    middle = np.nan_to_num(_spread(flat.x[says], flat.y[says]).mean(axis=1))
    right, low = (middle - np.array(grid.size[::-1]) * grid.cell / 2).tolist()
    return flat, Place((right, low), grid.cell, code, positions.downwards)


def _seams(lon: Array, x: Array, y: Array) -> np.ndarray:
    """`[P]` seams of the projection up to each report: torn at 180 degrees, it has no straight line across."""
    with np.errstate(invalid="ignore"):  # inf less inf
        torn = (np.abs(np.diff(lon)) > 180.0) & (np.hypot(np.diff(x), np.diff(y)) > _TORN)
    return np.append(0, np.cumsum(torn))


def _utm(x: Array, y: Array, source: str) -> str:
    """The code of the UTM zone in which the median position lies."""
    low, high = np.percentile(x, (1, 99))
    if high - low > 180.0:  # across the line at which 179 is followed by -179: here by 181
        x = x % 360.0
        low, high = np.percentile(x, (1, 99))
    latitude = float(np.median(y))
    if high - low > _WIDEST or abs(latitude) > 84:
        raise UserError(
            f"{source}: from {low:.1f} to {high:.1f} degrees of longitude, at latitude {latitude:.1f}, is no part of "
            "one UTM zone; expected grid.crs, a projection in metres such as EPSG:6933 (world) or EPSG:3035 (Europe)"
        )
    # Zones of 6 degrees from 180 W on: 8.5 E is in 1 + floor(188.5 / 6) = 32. The code of the north serves the south
    # too, where y is then negative: only differences count here.
    zone = 1 + int((float(np.median(x)) + 180.0) // 6.0) % 60
    return f"EPSG:326{zone:02d}"


def _breaks(positions: Positions, grid: Gridding) -> np.ndarray:
    """`[P]` whether a report is the first of an uninterrupted path."""
    first = np.ones(len(positions.time), bool)
    # 1e-9: times since 1970 have errors of 1e-7 s, and a gap of exactly `max_gap` is bridged.
    gap = np.diff(positions.time) > grid.max_gap * (1 + 1e-9) + 1e-6
    first[1:] = (np.diff(positions.piece) != 0) | gap
    return first


def _sampled(positions: Positions, grid: Gridding) -> tuple[np.ndarray, Array, Array, np.ndarray]:
    """Every path at its first report and each `step` after it, on the straight lines between reports.

    Returns:
        place: `[S]` for each sample the index of the first report of its path.
        x, y: `[S]`.
        last: `[S]` whether the path of the sample ends with the target's last report.
    """
    start = np.flatnonzero(_breaks(positions, grid))
    end = np.concatenate([start[1:], [len(positions.time)]]) - 1
    length = positions.time[end] - positions.time[start]
    with np.errstate(over="ignore"):  # inf is too many, and refused as such
        whole = np.floor(length / grid.step + 1e-6) + 1
    if whole.sum() > _MOST:
        raise UserError(
            f"kernel.step={grid.step:g}: makes {whole.sum():.3g} steps of it, expected at most {_MOST:,}"
        )
    # All paths one after the other on one axis of time, for one call of interp. Example: reports at 7 9 | 3 5 8 with a
    # pause of 1 between the paths stand at 0 2 | 3 5 8, and with a step of 2 are sampled at 0 2 | 3 5 7.
    pause = np.concatenate([[0.0], np.cumsum(length + 1.0)[:-1]])
    path = np.repeat(np.arange(len(start)), end - start + 1)
    axis = positions.time - positions.time[start][path] + pause[path]
    of = np.repeat(np.arange(len(start)), whole.astype(np.int64))
    # Rounding must not carry the last sample into the pause, where the line leads to another target.
    wanted = np.minimum(ranks(of) * grid.step, length[of]) + pause[of]
    x, y = (np.interp(wanted, axis, column) for column in (positions.x, positions.y))
    # Pieces are in the order of the file, perhaps the newest first.
    latest = np.full(positions.track.max() + 1, -np.inf)
    np.maximum.at(latest, positions.track, positions.time)
    final = positions.time[end] == latest[positions.track[end]]
    return start[of], x, y, final[of]


def _cut(
    cells: np.ndarray, place: np.ndarray, last: np.ndarray, flat: Positions, grid: Gridding
) -> tuple[Tracks, dict[str, int]]:
    """The runs of cells inside the grid, of sufficient length."""
    inside = cells >= 0
    same = np.diff(place) == 0
    # A run begins where the one before is of another path or outside, and ends likewise.
    begins = np.flatnonzero(inside & ~np.concatenate([[False], same & inside[:-1]]))
    ends = np.flatnonzero(inside & ~np.concatenate([same & inside[1:], [False]]))
    # Left the grid: a further sample of the same path follows. Else it ends with the path: with an exit only where that
    # is the last of the target and the recording does not just stop.
    left = np.concatenate([same, [False]])[ends]
    lengths = ends - begins + 1
    exits = left | (last[ends] & grid.exits)
    # A track of one cell that does not exit has no step.
    kept = (lengths >= grid.shortest) & (exits | (lengths > 1))
    chosen = np.repeat(kept, lengths)
    first = begins[kept]
    # Steps since the first path that is kept, to the nearest one (another path may lie at any time, 10^300 s before);
    # in its path a run begins some samples after the first.
    within = first - np.searchsorted(place, place[first])
    time = flat.time[place[first]]
    clock = np.rint((time - time.min(initial=np.inf)) / grid.step).astype(np.int64)
    made = Tracks(
        cells[inside][chosen],
        ends_of(lengths[kept]),
        exits[kept],
        flat.track[place[first]],
        clock + within,
    )
    counts = {
        _OUTSIDE: int((~inside).sum()),
        f"steps in {counted_words(int((~kept).sum()), 'track')} of fewer than {max(grid.shortest, 2)} cells": int(
            lengths[~kept].sum()
        ),
        "steps kept": len(made.cells),
        "tracks kept": len(made),
    }
    return made, counts
