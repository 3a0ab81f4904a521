"""Positions from a data frame or from columns of one's own names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import trackmdp as tm
from tests.recordings.test_positions import read
from tests.tracks import digest_of
from trackmdp.errors import UserError
from trackmdp.recordings.positions import frame_positions

OPTIONS: dict[str, Any] = {"size": (4, 4), "cell": 10.0, "step": 1.0, "min_length": 1}


def frame() -> Any:
    pandas = pytest.importorskip("pandas")
    count = 12
    steps = np.tile(np.arange(5), count)
    x = np.tile(np.linspace(1, 39, 5), count)
    return pandas.DataFrame(
        {"device": np.repeat(np.arange(count), 5), "seen": steps, "x": x, "y": 5.0 + 0 * x}
    )


COLUMNS = ["id:device", "time:seen"]


def test_a_frame_and_columns_of_ones_own_are_read_as_a_file_is(tmp_path: Path) -> None:
    table = frame()
    table.to_csv(tmp_path / "a.csv", index=False)
    usual = table.rename(columns={"device": "id", "seen": "time"})
    usual.to_csv(tmp_path / "b.csv", index=False)
    digests = {
        digest_of(tm.load_tracks(source, **OPTIONS, **more).tracks)
        for source, more in (
            (table, {"columns": COLUMNS}),
            (table, {"columns": dict(each.split(":") for each in COLUMNS)}),
            (tmp_path / "a.csv", {"columns": COLUMNS}),
            (usual, {}),
            (table.set_axis(range(4), axis=1), {"columns": ["id:0", "time:1", "x:2", "y:3"]}),
            (tmp_path / "b.csv", {}),
        )
    }
    assert len(digests) == 1
    run = tm.train(
        tm.load_tracks(usual, **OPTIONS),
        "model_based",
        total_frames=2000,
        frames_per_batch=1000,
        envs=50,
    )
    assert run.summary["place"]["cell"] == 10.0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({}, "load_tracks: not a table of positions (columns device, seen, x, y: expected id"),
        ({"columns": ["id:nobody", "time:seen"]}, "load_tracks: not a table of positions"),
        (
            {"columns": ["device:id"]},
            "kernel.columns=['device:id']: expected a list, each one of id, time, x, y, lat, lon",
        ),
    ],
)
def test_a_column_that_is_not_there_is_named(more: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        tm.load_tracks(frame(), **OPTIONS, **more)
    assert str(caught.value).startswith(message)


def test_a_file_with_neither_positions_nor_cells_is_refused_by_its_columns(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("device_id,when,breite,laenge\n1,0,54.3,10.1\n")
    with pytest.raises(UserError) as caught:
        tm.load_tracks(tmp_path / "a.csv", **OPTIONS)
    assert "(columns device_id, when, breite, laenge: expected id (" in str(caught.value)
    assert "kernel.columns" in str(caught.value)


@pytest.mark.parametrize("format", ["gpx", "cells"])
def test_columns_and_frames_are_those_of_a_table(tmp_path: Path, format: str) -> None:
    with pytest.raises(UserError, match=f"^kernel.format={format}: .* points with kernel.columns="):
        tm.load_tracks(tmp_path / "a.gpx", format=format, columns=COLUMNS, **OPTIONS)
    with pytest.raises(UserError, match=f"^kernel.format={format}: .* points with a DataFrame"):
        tm.load_tracks(pd.DataFrame(), format=format, **OPTIONS)


@pytest.mark.parametrize("again", ["x", "X", "TIME"])
def test_a_column_that_is_there_twice_is_refused(tmp_path: Path, again: str) -> None:
    with pytest.raises(UserError, match=f"two columns called {again},"):
        read(tmp_path, f"id,time,x,y,{again}\n1,2,3,4,5\n")
    assert len(read(tmp_path, "id,time,x,y,v,V\n1,2,3,4,5,6\n").time) == 1


@pytest.mark.parametrize("named", ["x", "lon"])
def test_of_a_table_with_x_y_and_lat_lon_those_that_are_named_count(named: str) -> None:
    table = pd.DataFrame({"id": [1], "t": 0, "x": 2.0, "y": 3.0, "lon": 8.5, "lat": 47.5})
    assert frame_positions(table, [f"{named}:{named}"]).geographic == (named == "lon")
