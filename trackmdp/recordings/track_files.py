"""Recorded tracks from a file of any format: cells as they stand, or positions that are brought onto the grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from trackmdp.arrays.files import column_names, once
from trackmdp.errors import UserError, require
from trackmdp.grid.place import Place
from trackmdp.recordings.gridding import Gridding, to_tracks
from trackmdp.recordings.positions import (
    ALIASES,
    LONGEST,
    Positions,
    frame_positions,
    geojson,
    gpx,
    mot,
    position_table,
    sumo,
)
from trackmdp.recordings.tracks import Tracks, draw_names, read_tracks, split
from trackmdp.untrusted import decoded, opened

_GAP = 3
"""Steps that are bridged where no `kernel.max_gap` is given."""

Reader: TypeAlias = Callable[..., Positions]
Parts: TypeAlias = tuple[Tracks, Tracks, Tracks]
"""Tracks to learn from, to choose by, and held out."""
Draw: TypeAlias = tuple[float, float, int]
"""Shares held out and to choose by, and the seed of the draw."""


_READERS: dict[str, tuple[Sequence[str], str, Sequence[str], Reader]] = {
    "points": ((".parquet",), "a table of positions", ("pandas", "pyarrow"), position_table),
    "geojson": (
        (".geojson", ".json"),
        "GeoJSON with the times of its points",
        ("pandas",),
        geojson,
    ),
    "gpx": ((".gpx",), "a GPX track log", ("gpxpy", "defusedxml", "pandas"), gpx),
    "mot": ((".txt",), "MOT-Challenge text", ("pandas",), mot),
    "sumo": ((".xml",), "SUMO's fcd-output", ("defusedxml", "pandas"), sumo),
}
"""Format -> endings of its files, its name in messages, the modules it needs, and its reader."""

_FORMATS = {".npz": "cells"} | {end: kind for kind, (ends, *_) in _READERS.items() for end in ends}


def _source(path: Any) -> str:
    """The name of a file, or of a DataFrame, in messages."""
    return f"kernel.path={path}" if isinstance(path, str | Path) else "load_tracks"


def read_positions(path: Any, kind: str, columns: Sequence[str] = ()) -> Positions:
    """The positions in a file, or in a DataFrame of pandas.

    Args:
        path: the file; it may be a link, since the user named it. Or the DataFrame.
        kind: one of the choices of `kernel.format` but `cells`.
        columns: names of the columns of a table (`kernel.columns`).

    Raises:
        UserError: there is no such file, it is too large, not of that form, or without reports, and why.
    """
    source, (_, words, needed, reader) = _source(path), _READERS[kind]
    if isinstance(path, str | Path):
        for module in needed:
            require(module, "tracks", source)
        with (
            opened(Path(path), most=LONGEST, source=source, links=True) as stream,
            decoded(source, words),
        ):
            found = reader(stream, columns) if columns else reader(stream)
    else:
        with decoded(source, words):
            found = frame_positions(path, columns)
    if len(found.time):
        return found
    left = [f"{count} {why}" for why, count in found.dropped.items() if count]
    if left and found.geographic:
        left.append("expected lat -90 to 90 and lon -180 to 180")
    counts = "; ".join([f"{found.read} reports read", *left])
    raise UserError(f"{source}: no positions, expected {words} ({counts})")


def read_track_file(
    path: Any,
    size: tuple[int, int],
    exits: bool,
    shortest: int,
    format: str | None,
    given: Mapping[str, Any],
    draw: Draw,
) -> tuple[Parts, Mapping[str, int], Place | None]:
    """The three parts of the tracks, the counts of reports read, cut and dropped, and the place of the grid.

    Of cells nothing is dropped, and their place is the one by hand.

    Args:
        path: the file, or positions as a DataFrame of pandas.
        size: rows and columns of the grid.
        exits: whether the target left the grid at the end of each track.
        shortest: fewest cells of a track.
        format: one of the choices of `kernel.format`; None: by the ending of the name and the columns.
        given: `step`, `cell`, `max_gap`, `origin` and `crs` (`Gridding`), and `columns`; None where not given.
        draw: as of `tracks.draw_names`.

    Raises:
        UserError: the file is not of that form, an option is missing or does not go with it, or of a part no track is
            left.
    """
    own = {name: value for name, value in given.items() if value is not None}
    columns = tuple(own.pop("columns", ()))
    in_memory = not isinstance(path, str | Path)
    source = _source(path)
    kind = "points" if in_memory or columns else format or _format_of(path)
    if format not in (None, kind):
        table = "a DataFrame" if in_memory else f"kernel.columns={list(columns)}"
        raise UserError(
            f"kernel.format={format}: expected points with {table}, of a table of positions"
        )
    if kind == "cells":
        place = _place_of_cells(own, source)
        tracks = once(read_tracks, path, size, exits, shortest)
        return split(tracks, *draw), {}, place
    for option, expected in (
        ("kernel.step", "seconds from one cell to the next"),
        ("grid.cell", "the side of a cell in metres"),
    ):
        if option.partition(".")[2] not in own:
            raise UserError(f"{option}: missing, expected {expected}; {source} holds positions")
    if "origin" in own:
        # Of a list no hash can be taken, by which `once` keeps.
        own["origin"] = tuple(map(float, own["origin"]))
    made = Gridding(
        size=size, shortest=shortest, exits=exits, **({"max_gap": _GAP * own["step"]} | own)
    )
    given_as = path, kind, columns, made, draw
    return _on_grid(*given_as) if in_memory else once(_on_grid, *given_as)


def _place_of_cells(own: Mapping[str, Any], source: str) -> Place | None:
    """The place by hand of the grid of a file of cells.

    Raises:
        UserError: a part of it is missing, or there is an option of positions.
    """
    for name in ("step", "max_gap"):
        if name in own:
            raise UserError(
                f"kernel.{name}={own[name]:.15g}: only for positions; {source} holds cells"
            )
    place = Place.of(*(own.get(name) for name in ("cell", "origin", "crs")))
    if place is None and own:
        expected = "grid.cell and grid.origin, the place of the grid"
        raise UserError(f"grid.{min(own)}: expected {expected}; {source} holds cells")
    return place


def _on_grid(
    path: Any, kind: str, columns: Sequence[str], grid: Gridding, draw: Draw
) -> tuple[Parts, Mapping[str, int], Place]:
    """See `read_track_file`."""
    positions = read_positions(path, kind, columns)
    # Drawn first: what is held out must not move the grid, nor change the draw by leaving it.
    names = np.unique(positions.track)
    held_out, _ = draw_names(names, *draw)
    tracks, loaded, place = to_tracks(positions, grid, _source(path), held_out)
    return split(tracks, *draw, names=names), loaded, place


def _format_of(path: str | Path) -> str:
    """The format that the file's name stands for; of a .csv the columns decide.

    Raises:
        UserError: the ending stands for none.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        names = {name.strip().lower() for name in column_names("kernel.path", path)}
        positions = {name for own in ("x", "y", "lat", "lon") for name in ALIASES[own]}
        of_cells = names & {"track", "cell", "row", "column"} and not names & positions
        return "cells" if of_cells else "points"
    if suffix not in _FORMATS:
        known = ", ".join([".csv", *_FORMATS])
        raise UserError(
            f"kernel.path={path}: expected a file that ends with one of {known}, or kernel.format"
        )
    return _FORMATS[suffix]
