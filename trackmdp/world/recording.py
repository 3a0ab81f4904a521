"""Recorded tracks in a file, `recording.npz`: the three parts as they are in memory; nothing is unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.arrays import LARGE, load_npz, npz_bytes
from trackmdp.untrusted import decoded, opened
from trackmdp.world.tracks import Recorded, Tracks

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
