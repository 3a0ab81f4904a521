"""Recorded tracks from a file of any format: cells as they stand, or positions that are brought onto the grid."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from trackmdp.errors import UserError, require
from trackmdp.untrusted import decoded, opened
from trackmdp.world.files import LARGE, column_names, load_npz, npz_bytes, once
from trackmdp.world.gridding import Gridding, to_tracks
from trackmdp.world.positions import ALIASES, LONGEST, Positions, geojson, gpx, mot, position_table, sumo
from trackmdp.world.tracks import Recorded, Tracks, check_tracks, read_tracks

_GAP = 3
"""Steps that are bridged where no `kernel.max_gap` is given."""

Reader: TypeAlias = Callable[[BinaryIO], Positions]


_READERS: dict[str, tuple[Sequence[str], str, Sequence[str], Reader]] = {
    "points": ((".parquet",), "a table of positions", ("pandas", "pyarrow"), position_table),
    "geojson": ((".geojson", ".json"), "GeoJSON with the times of its points", ("pandas",), geojson),
    "gpx": ((".gpx",), "a GPX track log", ("gpxpy", "defusedxml", "pandas"), gpx),
    "mot": ((".txt",), "MOT-Challenge text", ("pandas",), mot),
    "sumo": ((".xml",), "SUMO's fcd-output", ("defusedxml", "pandas"), sumo),
}
"""Format -> how its files end, what a message calls it, the modules it takes, and what reads it."""

_FORMATS = {".npz": "cells"} | {end: kind for kind, (ends, *_) in _READERS.items() for end in ends}


def read_positions(path: str | Path, kind: str) -> Positions:
    """The positions in a file.

    Args:
        path: the file; it may be a link, since the user named it.
        kind: one of the choices of `kernel.format` but `cells`.

    Raises:
        UserError: there is no such file, it is too large, not of that form, or without reports.
    """
    source = f"kernel.path={path}"
    _, words, needed, reader = _READERS[kind]
    for module in needed:
        require(module, "tracks", source)
    with opened(Path(path), most=LONGEST, source=source, links=True) as stream, decoded(source, words):
        found = reader(stream)
    if not len(found.time):
        raise UserError(f"{source}: no positions, expected {words} ({found.read} reports read)")
    return found


def read_track_file(
    path: str | Path, size: tuple[int, int], exits: bool, shortest: int, format: str | None, gridding: Mapping[str, Any]
) -> tuple[Tracks, Mapping[str, int]]:
    """The tracks in a file, and how many of what was read, cut and dropped; of cells nothing is dropped.

    Args:
        path: the file.
        size: rows and columns of the grid.
        exits: whether the target left the grid at the end of each track.
        shortest: fewest cells of a track.
        format: one of the choices of `kernel.format`; None: by the ending of the name and the columns.
        gridding: `step`, `cell`, `max_gap`, `origin` and `crs`, None where not given (`Gridding`).

    Raises:
        UserError: the file is not of that form, an option is missing or does not go with it, or no track is left.
    """
    kind, source = format or _format_of(path), f"kernel.path={path}"
    given = {name: value for name, value in gridding.items() if value is not None}
    if kind == "cells":
        if given:
            name, value = next(iter(given.items()))
            raise UserError(f"kernel.{name}={value}: only for positions; {source} holds cells")
        return check_tracks(read_tracks(path, size, exits=exits), shortest, source), {}
    for name, what in (("step", "seconds from one cell to the next"), ("cell", "the side of a cell in metres")):
        if name not in given:
            raise UserError(f"kernel.{name}: missing, expected {what}; {source} holds positions")
    if "origin" in given:
        given["origin"] = tuple(map(float, given["origin"]))  # of a list no hash can be taken, by which `once` keeps
    own = {"max_gap": _GAP * given["step"]} | given
    made = Gridding(size=size, shortest=shortest, exits=exits, **own)
    return once(_on_grid, path, kind, made)


def _on_grid(path: str | Path, kind: str, grid: Gridding) -> tuple[Tracks, Mapping[str, int]]:
    """See `read_track_file`."""
    return to_tracks(read_positions(path, kind), grid, f"kernel.path={path}")


def _format_of(path: str | Path) -> str:
    """The format that the file's name stands for; of a .csv the columns tell.

    Raises:
        UserError: the ending stands for none.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        positions = {name for own in ("x", "y", "lat", "lon") for name in ALIASES[own]}
        return "points" if positions & {name.lower() for name in column_names("kernel.path", path)} else "cells"
    if suffix not in _FORMATS:
        known = ", ".join([".csv", *_FORMATS])
        raise UserError(f"kernel.path={path}: expected a file that ends with one of {known}, or kernel.format")
    return _FORMATS[suffix]


_PARTS = ("tracks", "validation", "held_out")
_KINDS = {"cells": "i", "first": "i", "exits": "b", "names": "i"}
"""Array of `Tracks` -> kind of its numbers."""


def recording_bytes(problem: Recorded) -> bytes:
    """The content of `recording.npz`; the same tracks, the same bytes."""
    return npz_bytes({f"{part}_{name}": getattr(getattr(problem, part), name) for part in _PARTS for name in _KINDS})


def read_recording(path: str | Path, num_cells: int) -> tuple[Tracks, Tracks, Tracks] | None:
    """The tracks to learn from, to choose by and held out; None where the file has not these, but columns.

    Raises:
        UserError: the file is missing or damaged, or a cell lies outside a grid of so many cells.
    """
    source = f"kernel.path={path}"
    if Path(path).suffix != ".npz":
        return None
    with opened(Path(path), most=LARGE, source=source, links=True) as stream, decoded(source, "recorded tracks"):
        arrays = load_npz(stream)
        if set(arrays) != {f"{part}_{name}" for part in _PARTS for name in _KINDS}:
            return None
        learned, chosen, judged = (
            _part({name: arrays[f"{part}_{name}"] for name in _KINDS}, num_cells) for part in _PARTS
        )
    return learned, chosen, judged


def _part(arrays: dict[str, Any], num_cells: int) -> Tracks:
    for name, array in arrays.items():
        if array.ndim != 1 or array.dtype.kind != _KINDS[name]:
            raise ValueError(f"{name} of {array.dtype}, shape {array.shape}")
    tracks = Tracks(
        **{name: array if _KINDS[name] == "b" else array.astype(np.int64) for name, array in arrays.items()}
    )
    # Whoever replays them takes `first` for places in `cells`, and a cell for a place in tables of the grid.
    whole = len(tracks.first) == len(tracks) + 1 == len(tracks.names) + 1 and len(tracks) > 0
    if not (whole and tracks.first[0] == 0 and tracks.first[-1] == len(tracks.cells) and (tracks.lengths > 0).all()):
        raise ValueError("tracks that do not follow each other")
    if not ((tracks.cells >= 0) & (tracks.cells < num_cells)).all():
        raise ValueError(f"a cell outside the grid of {num_cells} cells")
    return tracks
