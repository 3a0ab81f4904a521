"""Pieces of a target's path: those of a file stay apart, the latest ends it, and none leads around the world."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pandas as pd
import pytest

from trackmdp.recordings.gridding import Gridding, to_tracks
from trackmdp.recordings.positions import Positions, frame_positions, geojson
from trackmdp.recordings.tracks import Tracks


def lines(*features: tuple[int, ...]) -> Positions:
    """GeoJSON of one target: a feature for each tuple, with a line of three reports from each of its times."""
    content = [
        {
            "type": "Feature",
            "properties": {"id": "a", "coordTimes": [[t, t + 1, t + 2] for t in times]},
            "geometry": {"type": "MultiLineString", "coordinates": [[[8, 47]] * 3 for _ in times]},
        }
        for times in features
    ]
    collection = {"type": "FeatureCollection", "features": content}
    return geojson(io.BytesIO(json.dumps(collection).encode()))


def made(positions: Positions, **more: Any) -> Tracks:
    grid = Gridding(**({"size": (30, 60), "cell": 20, "shortest": 1, "exits": True} | more))
    return to_tracks(positions, grid, "here", np.array([]))[0]


def test_lines_of_several_features_of_one_target_are_pieces_of_their_own() -> None:
    found = lines((0, 10), (12,))
    assert found.piece.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert found.time.tolist() == [0, 1, 2, 10, 11, 12, 12, 13, 14]


def test_a_target_leaves_with_its_latest_report_also_where_the_file_begins_with_that() -> None:
    tracks = made(lines((100,), (0,)), step=1, max_gap=3)
    assert tracks.begins is not None
    assert tracks.begins.tolist() == [100, 0]
    assert tracks.exits.tolist() == [True, False]


@pytest.mark.parametrize(
    ("crs", "cell", "pieces"),
    [("EPSG:6933", 700_000, 2), ("EPSG:3832", 20_000, 1), (None, 20_000, 1)],
)
def test_a_projection_torn_at_180_degrees_cuts_tracks_there(
    crs: str | None, cell: float, pieces: int
) -> None:
    """A ship from 179.5 E to 179.6 W: on the map of the world it ends on the right and goes on from the left."""
    lon = [(179.5 + step / 10 + 180) % 360 - 180 for step in range(10)]
    table = pd.DataFrame({"id": "s", "time": np.arange(10) * 600.0, "lon": lon, "lat": 10.0})
    tracks = made(frame_positions(table), crs=crs, cell=cell, step=200, max_gap=1800)
    assert len(tracks) == pieces
    jumps = [
        np.abs(np.diff(tracks.cells[a:b] % 60)).max()
        for a, b in zip(tracks.first[:-1], tracks.first[1:], strict=True)
    ]
    assert max(jumps) <= 1


def test_a_piece_of_one_cell_that_does_not_exit_is_no_track() -> None:
    """It has no step; as a track its first step would be taken for an exit, which nobody has seen."""
    table = pd.DataFrame({"id": "a", "time": [0, 100, 101, 200], "x": 0.5, "y": 0.5})
    grid = Gridding(size=(3, 3), cell=1, shortest=1, exits=True, step=1, max_gap=5)
    tracks, counts, _ = to_tracks(frame_positions(table), grid, "here", np.array([]))
    assert tracks.lengths.tolist() == [2, 1]
    assert tracks.exits.tolist() == [False, True]
    assert counts["steps in 1 track of fewer than 2 cells"] == 1
