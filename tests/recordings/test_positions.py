"""Positions from each kind of file, as a user has it; damaged ones are refused in one line."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from trackmdp.errors import UserError, adding
from trackmdp.recordings.positions import (
    IGNORED,
    NO_IDENTITY,
    NO_POSITION,
    REPEATED,
    Positions,
    frame_positions,
    sumo,
)
from trackmdp.recordings.track_files import read_positions

NOON = 1714564800.0  # 2024-05-01T12:00:00Z

GPX = """<?xml version="1.0"?><gpx version="1.1" creator="t" xmlns="http://www.topografix.com/GPX/1/1">
<trk><name>a</name><trkseg>
<trkpt lat="47.5" lon="8.5"><time>2024-05-01T12:00:00Z</time></trkpt>
<trkpt lat="47.6" lon="8.5"><time>2024-05-01T12:00:05Z</time></trkpt></trkseg>
<trkseg><trkpt lat="47.6" lon="8.6"><time>2024-05-01T12:00:10Z</time></trkpt></trkseg></trk>
<trk><trkseg><trkpt lat="47.7" lon="8.7"></trkpt>
<trkpt lat="47.7" lon="8.8"><time>2024-05-01T14:00:00+02:00</time></trkpt></trkseg></trk></gpx>"""

LINES = """{"type": "FeatureCollection", "features": [
{"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[8.5, 47.5, 400], [8.5, 47.6]]},
 "properties": {"coordTimes": ["2024-05-01T12:00:00Z", "2024-05-01T12:00:05Z"]}},
{"type": "Feature", "geometry": {"type": "MultiLineString", "coordinates": [[[1, 2]], [[3, 4]]]}, "id": 7,
 "properties": {"coordinateProperties": {"times": [["2024-05-01T12:00:00Z"], ["2024-05-01T12:00:01Z"]]}}},
{"type": "Feature", "geometry": null, "properties": null}]}"""

POINTS = """{"type": "FeatureCollection", "features": [
{"type": "Feature", "geometry": {"type": "Point", "coordinates": [8.5, 47.5]}, "properties": {"MMSI": 3, "time": 5}},
{"type": "Feature", "geometry": {"type": "Point", "coordinates": [8.4, 47.5]}, "properties": {"MMSI": 3, "time": 4}}
]}"""

SUMO = """<fcd-export><timestep time="0.00"><vehicle id="b" x="1.5" y="2.5" speed="3"/></timestep>
<timestep time="5.00"><vehicle id="b" x="3" y="4"/><vehicle id="a" x="0" y="0"/><person id="p" x="9" y="8"/></timestep>
</fcd-export>"""

MOT = "1,2,100,50,20,60,1,1,1\n2,2,110,50,20,60,1\n1,1,0,0,10,10,1,1,1\n2,1,0,0,10,10,0,1,1\n3,-1,0,0,10,10,1,1,1\n"


AIS = """# Timestamp,Type of mobile,MMSI,Latitude,Longitude,SOG
01/05/2024 12:00:00,Class A,219000001,55.5,12.5,1
01/05/2024 12:00:10,Class A,219000001,55.6,12.5,1
01/05/2024 12:00:10,Class A,219000001,55.9,12.9,1
01/05/2024 12:00:20,Class A,219000001,91,181,1
01/05/2024 12:00:20,Class A,219000001,,,1
"""

ADSB = """time,icao24,lat,lon,track,callsign
1714564805,4b1803,47.6,8.5,90,SWR
1714564800,4b1803,47.5,8.5,90,SWR
1714564800,4e5,1,2,90,X
"""


def read(tmp_path: Path, text: str | bytes, kind: str = "points") -> Positions:
    file = tmp_path / "f"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_positions(file, kind)


def rows(found: Positions) -> list[tuple[float, ...]]:
    """(track, piece, time, x, y) of each report."""
    columns = (found.track, found.piece, found.time, found.x, found.y)
    return [tuple(row) for row in np.stack(columns, axis=1).tolist()]


def test_a_table_of_x_and_y(tmp_path: Path) -> None:
    """Targets by their sorted ids, reports by time, whatever the order and the spelling."""
    found = read(tmp_path, "\ufeffT,ID,Y,X,colour\n5,b,1,2,red\n0,b,3,4,red\n1.5,a,5,6.5,blue\n")
    assert rows(found) == [(0, 0, 1.5, 6.5, 5), (1, 1, 0, 4, 3), (1, 1, 5, 2, 1)]
    assert not found.geographic
    assert not found.downwards
    assert found.read == 3


def test_of_reports_at_one_time_the_first_counts(tmp_path: Path) -> None:
    lines = "".join(f"{k % 3},{k % 5},{k},{k}\n" for k in range(600))
    found = read(tmp_path, "id,t,x,y\n" + lines)
    assert found.dropped == {NO_POSITION: 0, REPEATED: 585}
    assert sorted(found.x.tolist()) == list(range(15))


def test_infinite_numbers_are_no_position(tmp_path: Path) -> None:
    """Nor a time: left in, they would sort last and stretch the path over everything."""
    found = read(
        tmp_path, "id,t,x,y\na,0,1,2\na,inf,1,2\na,1,-inf,2\na,2,1,inf\na,3,nan,2\na,4,5,6\n"
    )
    assert rows(found) == [(0, 0, 0, 1, 2), (0, 0, 4, 5, 6)]
    assert found.dropped == {NO_POSITION: 4, REPEATED: 0}


def test_ais_by_its_usual_columns(tmp_path: Path) -> None:
    found = read(tmp_path, AIS)
    assert rows(found) == [(0, 0, NOON, 12.5, 55.5), (0, 0, NOON + 10, 12.5, 55.6)]
    assert found.geographic
    assert found.dropped == {NO_POSITION: 2, REPEATED: 1}
    assert found.read == 5
    other = "MMSI,BaseDateTime,LAT,LON\n5,2024-05-01T12:00:00,30,-80\n"
    assert rows(read(tmp_path, other)) == [(0, 0, NOON, -80, 30)]


def test_ads_b_by_its_usual_columns(tmp_path: Path) -> None:
    """`track` is a heading there, and 4e5 an id."""
    found = read(tmp_path, ADSB)
    assert rows(found) == [(0, 0, NOON, 8.5, 47.5), (0, 0, NOON + 5, 8.5, 47.6), (1, 1, NOON, 2, 1)]


def test_seconds_may_be_texts() -> None:
    """Not years, which pandas takes 1000 and 1060 for."""
    table = pd.DataFrame({"id": "a", "time": ["1000", "1060", "1060.5"], "x": 0.0, "y": 0.0})
    assert frame_positions(table).time.tolist() == [1000, 1060, 1060.5]


@pytest.mark.parametrize(
    "times", [pd.period_range("2024-01", periods=2, freq="D"), [True, False], [1j, 2j]]
)
def test_times_that_are_neither_seconds_nor_dates_are_refused(times: Any) -> None:
    """Not counted in days, or cut to real parts."""
    table = pd.DataFrame({"id": "a", "time": times, "x": 0.0, "y": 0.0})
    with pytest.raises(ValueError, match=r"time of entry 1.*seconds or a time"):
        frame_positions(table)


def test_a_column_of_missing_times_holds_none() -> None:
    table = pd.DataFrame({"id": "a", "time": [pd.NaT, pd.NaT], "x": [0.0, 1.0], "y": 0.0})
    assert np.isnan(frame_positions(table).time).all()


def test_parquet_is_as_csv(tmp_path: Path) -> None:
    times = pd.to_datetime(["2024-05-01T12:00:05", "2024-05-01T12:00:00"])
    table = pd.DataFrame({"id": [3, 3], "time": times, "x": [1, 2.5]})
    table = table.assign(y=[0, 1], other=["a", None])
    for stored in (table, table.set_index("time")):
        stored.to_parquet(tmp_path / "t.parquet")
        assert rows(read_positions(tmp_path / "t.parquet", "points")) == [
            (0, 0, NOON, 2.5, 1),
            (0, 0, NOON + 5, 1, 0),
        ]


@pytest.mark.parametrize("form", ["parquet", "json"])
def test_long_ids_stay_apart_where_one_is_missing(tmp_path: Path, form: str) -> None:
    ids = [2**60, 2**60 + 1, None]  # the same float
    if form == "parquet":
        table = pa.table({"id": ids, "t": [0, 0, 0], "x": [0, 0, 0], "y": [0, 0, 0]})
        parquet.write_table(table, tmp_path / "t.parquet")  # without a word of pandas
    else:
        point = {"type": "Point", "coordinates": [8, 47]}
        each = [{"geometry": point, "properties": {"id": own, "t": 0}} for own in ids]
        content = {"type": "FeatureCollection", "features": each}
        (tmp_path / "t.json").write_text(json.dumps(content))
    found = read_positions(tmp_path / f"t.{form}", "points" if form == "parquet" else "geojson")
    assert (found.track.tolist(), found.dropped[NO_POSITION]) == ([0, 1], 1)


def test_gpx_keeps_segments_apart(tmp_path: Path) -> None:
    found = read(tmp_path, GPX, "gpx")
    assert rows(found) == [
        (0, 0, NOON, 8.5, 47.5),
        (0, 0, NOON + 5, 8.5, 47.6),
        (0, 1, NOON + 10, 8.6, 47.6),
        (1, 2, NOON, 8.8, 47.7),
    ]
    assert found.dropped == {NO_POSITION: 1, REPEATED: 0}


def test_geojson_of_lines_and_of_points(tmp_path: Path) -> None:
    assert rows(read(tmp_path, LINES, "geojson")) == [
        (0, 0, NOON, 1, 2),
        (0, 1, NOON + 1, 3, 4),
        (1, 2, NOON, 8.5, 47.5),
        (1, 2, NOON + 5, 8.5, 47.6),
    ]
    found = read(tmp_path, POINTS, "geojson")
    assert rows(found) == [(0, 0, 4, 8.4, 47.5), (0, 0, 5, 8.5, 47.5)]
    assert found.geographic


def test_mot_stands_where_the_box_stands(tmp_path: Path) -> None:
    """left + width / 2, top + height; frames are the time; what the ground truth marks is left out."""
    found = read(tmp_path, MOT, "mot")
    assert rows(found) == [(0, 0, 1, 5, 10), (1, 1, 1, 110, 110), (1, 1, 2, 120, 110)]
    assert found.downwards
    assert (found.dropped[IGNORED], found.dropped[NO_IDENTITY]) == (1, 1)


def test_a_long_value_is_not_handed_to_the_parser_in_small_pieces() -> None:
    """expat before 2.6 looks through it anew with each of them."""

    class Counted(io.BytesIO):
        reads = 0

        def read(self, size: int | None = -1) -> bytes:
            self.reads += 1
            return super().read(size)

    stream = Counted(SUMO.replace("<fcd-export", f'<fcd-export note="{"x" * 2**23}"', 1).encode())
    assert np.array_equal(sumo(stream).x, [0.0, 1.5, 3.0, 9.0])
    assert stream.reads <= 4


def test_sumo(tmp_path: Path) -> None:
    found = read(tmp_path, SUMO, "sumo")
    assert rows(found) == [(0, 0, 5, 0, 0), (1, 1, 0, 1.5, 2.5), (1, 1, 5, 3, 4), (2, 2, 5, 9, 8)]


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'

DAMAGED = {
    "no columns": ("points", "a,b\n1,2\n", "columns a, b: expected id (mmsi, icao24,"),
    "semicolons": ("points", "id;t;x;y\n", "'id;t;x;y': expected commas between columns"),
    "tabs": ("points", "id\tt\tx\ty\n", "expected commas between columns"),
    "both": ("points", "id,t,x,y,lat,lon\n", "expected either x, y or lat, lon"),
    "half": ("points", "id,t,x,lon\n", "expected either x, y or lat, lon"),
    "word": (
        "points",
        "id,t,easting,y\n1,1,1,2\n1,2,,2\n1,3,abc,2\n",
        "not a table of positions (easting of entry 3 is 'abc', expected a number)",
    ),
    "time": (
        "points",
        "id,t,x,y\n1,3,1,2\n1,yesterday,1,2\n",
        "not a table of positions (t of entry 2 is 'yesterday', expected seconds or a time)",
    ),
    "ragged": ("points", "id,t,x,y\n1,2,3,4\n1,2,3,4,5,6\n", "not a table of positions ("),
    "binary": ("points", b"\x00\xff\xfe" * 50, "not a table of positions ("),
    "parquet cut": ("points", b"PAR1" + bytes(50), "not a table of positions ("),
    "nothing": ("points", "", "not a table of positions (columns none: expected id ("),
    "no rows": (
        "points",
        "id,t,x,y\n",
        "no positions, expected a table of positions (0 reports read)",
    ),
    "nowhere": (
        "points",
        "id,t,x,y\n1,,1,1\n,1,1,1\n1,1,inf,1\n",
        "(3 reports read; 3 reports without a time or a position)",
    ),
    "swapped": (
        "points",
        "id,t,lat,lon\n1,0,147,-33\n1,1,147.1,-33\n",
        "(2 reports read; 2 reports without a time or a position; expected lat -90 to 90 and lon",
    ),
    "json cut": ("geojson", '{"type": "FeatureCollection", "features": [', "its content: not JSON"),
    "json other": ("geojson", "[1, 2]", "not GeoJSON with the times of its points ("),
    "json untimed": (
        "geojson",
        LINES.replace("coordTimes", "when"),
        "(feature 1: expected a time for each point, as times",
    ),
    "json short": (
        "geojson",
        LINES.replace('["2024-05-01T12:00:01Z"]', "[]"),
        "not GeoJSON with the times of its points (",
    ),
    "gpx cut": ("gpx", GPX[:200], "not a GPX track log ("),
    "gpx other": ("gpx", "<html></html>", "a GPX track log"),
    "gpx bomb": ("gpx", BOMB + "<gpx>&b;</gpx>", "not a GPX track log (DTDForbidden"),
    "mot words": ("mot", "1,2,a,b,c,d\n", "not MOT-Challenge text ("),
    "mot short": (
        "mot",
        "1,2,3\n",
        "not MOT-Challenge text (3 columns, expected frame, id, left, top, width, height)",
    ),
    "sumo cut": ("sumo", SUMO[:120], "not SUMO's fcd-output ("),
    "sumo other": (
        "sumo",
        "<routes></routes>",
        "not SUMO's fcd-output (<routes>, expected <fcd-export>)",
    ),
    "sumo unnamed": ("sumo", SUMO.replace('id="b"', ""), "not SUMO's fcd-output ("),
    "sumo bomb": (
        "sumo",
        BOMB + "<fcd-export>&b;</fcd-export>",
        "not SUMO's fcd-output (DTDForbidden",
    ),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_refused_in_one_line(case: str, tmp_path: Path) -> None:
    kind, content, message = DAMAGED[case]
    with pytest.raises(UserError) as caught:
        read(tmp_path, content, kind)
    said = str(caught.value)
    assert said.startswith(f"kernel.path={tmp_path / 'f'}: ")
    assert message in said
    assert "\n" not in said
    assert len(said) < 500


@pytest.mark.parametrize("kind", ["points", "gpx", "sumo", "mot", "geojson"])
def test_only_ordinary_files_of_bounded_size_are_read(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, message in (
        ("pipe", "a pipe or a device, expected an ordinary file"),
        ("none", "no such file"),
    ):
        with pytest.raises(UserError, match=rf"^kernel\.path=.*/{name}: {message}$"):
            read_positions(tmp_path / name, kind)
    monkeypatch.setattr("trackmdp.recordings.track_files.LONGEST", 10)
    with pytest.raises(UserError, match="50 bytes, expected at most 10"):
        read(tmp_path, "x" * 50, kind)


def test_a_parquet_file_that_unfolds_to_too_much_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A column of one value takes a few bytes, however long it is."""
    zeros = np.zeros(200_000)
    pd.DataFrame({"id": zeros, "t": zeros, "x": zeros, "y": zeros}).to_parquet(
        tmp_path / "t.parquet"
    )
    monkeypatch.setattr("trackmdp.recordings.positions.LONGEST", 100_000)
    assert (tmp_path / "t.parquet").stat().st_size < 100_000
    with pytest.raises(
        UserError, match=r"not a table of positions \([\d,]+ bytes once unfolded, expected"
    ):
        read_positions(tmp_path / "t.parquet", "points")


def test_one_long_text_in_all_rows_of_a_parquet_file_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trackmdp.recordings.positions.LONGEST", 100_000)
    numbers = {name: np.arange(1000.0) for name in ("t", "x", "y")}
    for size, fine in ((50, True), (150, False)):
        pd.DataFrame({"id": "v" * size, **numbers}).to_parquet(tmp_path / "t.parquet")
        with (
            nullcontext()
            if fine
            else pytest.raises(UserError, match="150,000 bytes once unfolded, expected at most")
        ):
            assert len(read_positions(tmp_path / "t.parquet", "points").time) == 1000


def test_columns_of_lists_are_no_columns_of_a_parquet_file(tmp_path: Path) -> None:
    pd.DataFrame({"id": [1, 1], "t": [0, 5], "x": [[1.0], [2.0]], "y": [0, 1]}).to_parquet(
        tmp_path / "t.parquet"
    )
    with pytest.raises(UserError, match="columns id, t, y: expected either x, y or lat, lon"):
        read_positions(tmp_path / "t.parquet", "points")


@pytest.mark.parametrize(
    ("kind", "module"), [("points", "pandas"), ("gpx", "gpxpy"), ("sumo", "defusedxml")]
)
def test_a_missing_library_is_named_with_its_extra(
    kind: str, module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == module else found(name)
    )
    with pytest.raises(
        UserError, match=re.escape(f"needs {module}, which {adding('tracks')} adds") + "$"
    ):
        read(tmp_path, "", kind)
