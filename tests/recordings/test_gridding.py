"""From positions to cells, by hand: sampled, projected, put on the grid, cut, and counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trackmdp as tm
from tests.tracks import digest_of
from trackmdp.errors import UserError
from trackmdp.policies.saved import packed
from trackmdp.recordings.gridding import Gridding, said, to_tracks
from trackmdp.recordings.positions import Positions, table_of
from trackmdp.recordings.tracks import Recorded, Tracks


def seen(*reports: tuple[Any, ...], **more: Any) -> Positions:
    """Reports (id, time, x, y), perhaps with a piece."""
    return table_of(*(list(column) for column in zip(*reports, strict=True)), **more)


def grid(**more: Any) -> Gridding:
    """2 x 3 cells of 10 m from (0, 0), a step of 5 s:

    3 4 5 are the lower cells (y < 10), 0 1 2 the upper ones.
    """
    usual: dict[str, Any] = {
        "size": (2, 3),
        "cell": 10.0,
        "step": 5.0,
        "max_gap": 15.0,
        "origin": (0.0, 0.0),
    }
    return Gridding(**(usual | {"crs": None, "shortest": 1, "exits": True} | more))


def cells(tracks: Tracks) -> list[list[int]]:
    return [
        tracks.cells[a:b].tolist() for a, b in zip(tracks.first[:-1], tracks.first[1:], strict=True)
    ]


def made(positions: Positions, **more: Any) -> tuple[Tracks, dict[str, int]]:
    return to_tracks(positions, grid(**more), "here", np.array([]))[:2]


def test_between_reports_a_straight_line() -> None:
    """At 0 s in x = 5, at 10 s in x = 25: at 5 s half way, in cell 4. Row 0 is the upper one."""
    tracks, _ = made(seen((0, 0, 5, 5), (0, 10, 25, 5), (1, 0, 5, 5), (1, 5, 5, 19.9)))
    assert cells(tracks) == [[3, 4, 5], [3, 0]]
    assert tracks.exits.tolist() == [True, True]
    assert tracks.names.tolist() == [0, 1]
    down, _ = made(seen((0, 0, 5, 5), (0, 10, 25, 5), downwards=True))
    assert cells(down) == [[0, 1, 2]]


def test_the_step_counts_from_the_first_report() -> None:
    """Reports at 1, 4 and 9.9 s are sampled at 1 and 6 s: x = 5 and 5 + 2 + 20 · 2 / 5.9."""
    positions = seen((0, 1, 5, 5), (0, 4, 7, 5), (0, 9.9, 27, 5))
    assert cells(made(positions)[0]) == [[3, 4]]
    assert cells(made(positions, step=1.0)[0]) == [[3, 3, 3, 3, 4, 4, 4, 5, 5]]


def test_times_of_today_are_exact_enough() -> None:
    """Since 1970 there have been 1.7e9 s; steps of .1 s are neither lost nor doubled."""
    now = 1714564800.0
    positions = seen(*((0, now + 0.1 * k, 1.5 + k, 5) for k in range(29)))
    tracks, _ = made(positions, step=0.1, max_gap=0.1)
    assert cells(tracks) == [[3 + int(1.5 + k) // 10 for k in range(29)]]


def test_the_last_sample_stays_at_the_last_report() -> None:
    """A microsecond short of two steps counts as two; what comes next on the line is another target, far away."""
    tracks, _ = made(seen((0, 0, 5, 5), (0, 9.999999, 25, 5), (1, 0, 1e9, 5)))
    assert cells(tracks) == [[3, 4, 5]]


def test_a_position_beyond_the_projection_is_outside() -> None:
    near = [(0, 5 * k, 9.0 + 1e-6 * k, 47.0) for k in range(200)]
    wide: dict[str, Any] = {"size": (3, 3), "cell": 100.0, "origin": None}
    reports = [*near, (1, 0, -81.0, 0.0), (1, 5, 9.0, 47.0)]
    tracks, report = made(seen(*reports, geographic=True), **wide)
    assert cells(tracks)[0] == [4] * 200
    assert report["steps outside of the grid"] >= 1


def test_positions_beyond_the_projection_do_not_move_the_grid() -> None:
    """A third of all reports, far more than the percentiles leave out: the others stay in the middle of the grid."""
    near = [(0, 5 * k, 9.0 + 1e-6 * k, 47.0) for k in range(20)]
    away = [(1, 5 * k, -81.0, 0.0) for k in range(10)]
    tracks, _ = made(
        seen(*near, *away, geographic=True), size=(3, 3), cell=100.0, origin=None, crs="EPSG:32632"
    )
    assert cells(tracks) == [[4] * 20]


def test_a_longer_gap_cuts_a_track() -> None:
    """15 s are bridged, 16 s are not; before the gap the target has not left."""
    tracks, report = made(seen((0, 0, 5, 5), (0, 15, 15, 5), (0, 31, 25, 5), (0, 36, 25, 15)))
    assert cells(tracks) == [[3, 3, 4, 4], [5, 2]]  # x = 5, 8.3, 11.7, 15
    assert tracks.names.tolist() == [0, 0]
    assert tracks.exits.tolist() == [False, True]
    assert report["cuts where no report came for 15 s or the file has a break"] == 1
    assert made(seen((0, 0, 5, 5), (0, 15, 15, 5)), exits=False)[0].exits.tolist() == [False]


def test_pieces_of_the_file_stay_apart() -> None:
    tracks, _ = made(seen((0, 0, 5, 5, 0), (0, 5, 15, 5, 0), (0, 10, 25, 5, 1)))
    assert cells(tracks) == [[3, 4], [5]]


def test_a_track_is_cut_where_it_leaves_the_grid() -> None:
    """Right and upper edges are outside; who comes back is a track of the same name."""
    tracks, report = made(
        seen(
            (0, 0, 25, 5),
            (0, 5, 30, 5),
            (0, 10, 29.9, 5),
            (0, 15, 29.9, 20),
            (1, 0, -0.1, 5),
            (1, 5, 0, 0),
        ),
        exits=False,
    )
    assert cells(tracks) == [[5], [5], [3]]
    assert tracks.exits.tolist() == [True, True, False]
    assert tracks.names.tolist() == [0, 0, 1]
    assert report["steps outside of the grid"] == 3


def test_short_tracks_are_dropped_and_all_is_counted() -> None:
    first, second = [(0, 0, 5, 5), (0, 10, 25, 5)], [(1, 0, 5, 5), (1, 0, 6, 5), (1, 99, 5, 5)]
    positions = seen(*first, *second, (2, 0, None, 5), (2, 5, 50, 5))
    tracks, report = made(positions, shortest=2)
    assert cells(tracks) == [[3, 4, 5]]
    assert report == {
        "reports read": 7,
        "targets": 3,
        "reports without a time or a position": 1,
        "reports at a time seen before": 1,
        "cuts where no report came for 15 s or the file has a break": 1,
        "steps": 6,
        "steps outside of the grid": 1,
        "steps in 2 tracks of fewer than 2 cells": 2,
        "steps kept": 3,
        "tracks kept": 1,
        "rows that nearly all positions span": 1,  # of 10: y is 5 everywhere, x from 5 to 50
        "columns that they span": 5,
    }
    assert not any("span" in line for line in made(seen(*first))[1])  # none outside
    assert (
        said({"reports read": 1234, "steps": 0, "tracks kept": 2})
        == "1,234 reports read, 2 tracks kept"
    )
    with pytest.raises(
        UserError,
        match=r"^here: no track of at least 4 cells; 7 reports read, .*6 steps in 4 tracks",
    ):
        made(positions, shortest=4, size=(9, 9))


def test_without_an_origin_the_middles_agree() -> None:
    """x from 100 to 160, y from 0 to 30 (but for one report in a hundred): middle (130, 15), so from (115, 5)."""
    reports = [(0, 5 * k, 100 if k < 300 else 160, 0 if k % 2 else 30) for k in range(600)]
    positions = seen(*reports, (1, 0, 9e9, 9e9), (2, 0, 116, 6), (2, 5, 116, 16), (3, 0, 144, 24))
    tracks, _ = made(positions, origin=None)
    assert cells(tracks) == [[3, 0], [2]]


def test_degrees_become_metres_of_the_utm_zone() -> None:
    """On the central meridian of zone 32 (9 E) x is 500,000; a minute of latitude is about 1,853 m."""
    north = 47.0 + 1 / 60
    positions = seen(
        (0, 0, 9.0, 47.0), (0, 5, 9.0, north), (0, 10, 9.0 + 2 / 60, north), geographic=True
    )
    # From 500 m west and south of the first: (500, 500), (500, 2353), and 2 · 1,853 · cos(47°) = 2,534 m further east.
    west, south = 9.0 - 500 / 76_055, 47.0 - 500 / 111_170
    tracks, _ = made(positions, cell=1000.0, size=(4, 5), origin=(west, south))
    assert cells(tracks) == [[15, 5, 8]]
    swiss, _ = made(positions, cell=1000.0, size=(4, 5), origin=(west, south), crs="EPSG:2056")
    # 1.6 degrees east of its meridian the Swiss grid is turned by 1.1 degrees: 37 m less to the right, 2,997 m
    assert cells(swiss) == [[15, 5, 7]]
    # in the south, 1,111 m apart around the middle of three rows of 1,000 m
    below = seen((0, 0, 9.0, -47.0), (0, 5, 9.0, -46.99), geographic=True)
    assert cells(made(below, cell=1000.0, size=(3, 1), origin=None)[0]) == [[2, 0]]


AT_SEA = seen((0, 0, 1, 1), geographic=True)


@pytest.mark.parametrize(
    ("positions", "more", "message"),
    [
        (seen((0, 0, 1, 1)), {"crs": "EPSG:2056"}, "here: has x and y, which are not projected"),
        (
            AT_SEA,
            {"crs": "EPSG:4326"},
            "grid.crs=EPSG:4326: WGS 84, expected a projected coordinate system in",
        ),
        (
            AT_SEA,
            {"crs": "EPSG:2225"},
            "grid.crs=EPSG:2225: NAD83 / California zone 1 (ftUS), expected a projected",
        ),
        (AT_SEA, {"crs": "EPSG:1"}, "grid.crs=EPSG:1: no known coordinate system ("),
        (
            AT_SEA,
            {"origin": (9.0, 470.0)},
            "grid.origin=[9.0, 470.0]: outside of EPSG:32631, expected lon, lat",
        ),
        (
            seen((0, 0, 1, 1), (0, 5, 40, 1), geographic=True),
            {},
            "here: from 1.4 to 39.6 degrees of longitude, at ",
        ),
        (
            seen((0, 0, 1, 88), geographic=True),
            {},
            "here: from 1.0 to 1.0 degrees of longitude, at latitude 88.0",
        ),
        (
            seen((0, 0, 5, 5), (0, 9e9, 5, 5)),
            {"max_gap": 1e10},
            "kernel.step=5: makes 1.8e+09 steps of it, expected ",
        ),
        (
            seen((0, 0, 5, 5), (0, 1, 5, 5)),
            {"step": 5e-324},
            "kernel.step=4.94066e-324: makes inf steps of it, expected ",
        ),
        (seen((0, 0, 5, 5), (0, 5, 7, 5)), {"cell": 5e-324}, "here: no track of at least 1 cells"),
        (
            seen((0, 0, 15.42, 47.06), (0, 5, 15.43, 47.061)),  # degrees as x and y
            {"cell": 100},
            "here: nearly all positions lie within 0.0098 x 0.00098, far less than a cell (grid.cell=100)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(
    positions: Positions, more: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError) as caught:
        made(positions, **({"origin": None} | more))
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


REPORTS = st.tuples(
    st.integers(0, 3), st.integers(0, 60), st.integers(-20, 50), st.integers(-20, 40)
)


@given(st.lists(REPORTS, min_size=1))
def test_every_step_is_kept_or_counted(reports: list[tuple[int, int, int, int]]) -> None:
    try:
        tracks, report = made(seen(*reports), shortest=2)
    except UserError as error:
        assert "no track of at least 2 cells" in str(error)
        return
    dropped = [
        count
        for name, count in report.items()
        if name.startswith("steps ") and name != "steps kept"
    ]
    assert report["steps"] == report["steps kept"] + sum(dropped)
    assert report["steps kept"] == len(tracks.cells) == tracks.lengths.sum()
    assert (tracks.lengths >= 2).all()
    assert ((tracks.cells >= 0) & (tracks.cells < 6)).all()
    # one target alone gives the same tracks as among the others
    alone = _cells_or_none([report for report in reports if report[0] == reports[0][0]])
    name = sorted({str(report[0]) for report in reports}).index(str(reports[0][0]))
    assert alone == [
        row for row, own in zip(cells(tracks), tracks.names, strict=True) if own == name
    ]


def _cells_or_none(reports: list[tuple[int, int, int, int]]) -> list[list[int]]:
    try:
        return cells(made(seen(*reports), shortest=2)[0])
    except UserError:
        return []


CITY = Path(__file__).parents[1] / "data" / "city.csv"


def load(**more: Any) -> Recorded:
    return tm.load_tracks(
        CITY, (18, 15), **({"step": 5, "cell": 50, "t_max": 1, "cost": 0.1} | more)
    )


def test_the_city_is_read_from_python() -> None:
    tracks = load()
    parts = (tracks.tracks, tracks.validation, tracks.held_out)
    assert [len(part) for part in parts] == [502, 72, 144]
    names = np.concatenate([part.names for part in parts])
    assert len(set(names.tolist())) == len(names) == tracks.loaded["tracks kept"] == 718
    assert sum(len(part.cells) for part in parts) == tracks.loaded["steps kept"] == 17_967
    # vehicle 719 - 1 is the last one: at 5 s it is where the file says
    first = (
        tracks.tracks
        if 0 in tracks.tracks.names
        else tracks.held_out
        if 0 in tracks.held_out.names
        else parts[1]
    )
    place = first.first[first.names.tolist().index(0)]
    x, y = np.loadtxt(CITY, delimiter=",", skiprows=1, max_rows=1)[2:]
    everything = np.loadtxt(CITY, delimiter=",", skiprows=1)
    seen = everything[~np.isin(everything[:, 0], tracks.held_out.names)]
    low = np.percentile(seen[:, 2:], (1, 99), axis=0).mean(axis=0) - [15 * 25, 18 * 25]
    column, up = ((np.array([x, y]) - low) // 50).astype(int)
    assert first.cells[place] == (17 - up) * 15 + column


@pytest.mark.parametrize("geographic", [False, True])
def test_a_held_out_track_far_away_changes_nothing_that_is_learned(geographic: bool) -> None:
    """Neither the place of the grid, nor which tracks are drawn, nor the policy."""
    few = {"total_frames": 2000, "frames_per_batch": 500, "envs": 50}
    rng = np.random.default_rng(0)
    at = rng.uniform(0, 40, (40, 1, 2)) + rng.normal(0, 4, (40, 12, 2)).cumsum(axis=1)
    name, step = (each.ravel() for each in np.indices((40, 12)))

    def learned(shift: float, moved: Any) -> tuple[Recorded, Any]:
        x, y = np.moveaxis(at + shift * np.isin(np.arange(40), moved)[:, None, None], 2, 0)
        # A ten-thousandth of a degree is 7 to 11 m here; the shift leaves the UTM zone.
        wide = {"lon": 9 + x / 1e5, "lat": 47 + y / 1e5} if geographic else {"x": x, "y": y}
        table = {"id": 100 + name, "t": 5.0 * step} | {
            key: each.ravel() for key, each in wide.items()
        }
        options = {"cell": 10.0, "step": 5.0, "min_length": 2, "cost": 0.1}
        recorded = tm.load_tracks(pd.DataFrame(table), (9, 9), **options)
        return recorded, tm.train(recorded, "model_based", seed=0, **few).policy

    first, policy = learned(0.0, [])
    away, again = learned(1e6, first.held_out.names[:-1])
    assert (len(first.held_out), len(away.held_out)) == (8, 1)
    assert away.place == first.place
    for part in ("tracks", "validation"):
        assert digest_of(getattr(away, part)) == digest_of(getattr(first, part))
    assert packed(again).keys() == packed(policy).keys()
    assert all(map(np.array_equal, packed(again).values(), packed(policy).values()))
    with pytest.raises(UserError, match=r"leave, of \d+ tracks, none to judge on"):
        learned(1e6, first.held_out.names)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            {"step": None},
            "kernel.step: missing, expected seconds from one cell to the next; kernel.path=",
        ),
        (
            {"cell": None},
            "grid.cell: missing, expected the side of a cell in metres; kernel.path=",
        ),
        ({"origin": [1]}, "grid.origin=[1]: expected [x, y], or [lon, lat], or null"),
        ({"crs": "/etc/passwd"}, "grid.crs=/etc/passwd: expected a code such as EPSG:2056"),
        ({"crs": "EPSG:2056"}, "kernel.path="),
        ({"format": "gpx"}, "kernel.path="),
        (
            {"format": "ais"},
            "kernel.format=ais: expected one of cells, points, geojson, gpx, mot, sumo",
        ),
        ({"step": 0}, "kernel.step=0: expected a number > 0"),
    ],
)
def test_options_that_do_not_fit_are_refused(more: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as caught:
        load(**more)
    assert str(caught.value).startswith(message)


def test_cells_need_no_gridding(tmp_path: Path) -> None:
    file = tmp_path / "t.csv"
    file.write_text("track,cell\n0,1\n")
    with pytest.raises(
        UserError, match=r"^kernel\.step=50\.0: only for positions; kernel\.path=.* holds cells$"
    ):
        tm.load_tracks(file, 3, step=50)
    for place in ({"cell": 50}, {"origin": [1, 2]}, {"crs": "EPSG:2056"}):
        with pytest.raises(UserError, match=r": expected grid\.cell and grid\.origin, .* cells$"):
            tm.load_tracks(file, 3, **place)
    with pytest.raises(
        UserError,
        match=r"expected a file that ends with one of \.csv, \.npz, .*, or kernel\.format$",
    ):
        tm.load_tracks(tmp_path / "t.doc", 3)


def test_tracks_begin_at_the_recordings_clock() -> None:
    """The first report of all is at 100 s; target 1 comes 11 s later, is outside, and enters two steps on."""
    tracks, _ = made(
        seen((0, 100, 5, 5), (0, 110, 25, 5), (1, 111, 45, 5), (1, 131, 5, 5), (2, 104, 5, 5)),
        max_gap=30.0,
    )
    assert cells(tracks) == [[3, 4, 5], [5, 4, 3], [3]]
    assert tracks.begins is not None
    assert tracks.begins.tolist() == [0, 4, 1]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [-1e300, 1e300])
def test_the_clock_begins_with_the_first_track_that_is_kept(far: float) -> None:
    """Target 2 has a single report in a cell, at any time: too short to be kept."""
    reports = seen((0, 0, 5, 5), (0, 10, 25, 5), (1, 20, 5, 5), (1, 30, 25, 5), (2, far, 5, 5))
    tracks, _ = made(reports, shortest=2)
    assert tracks.begins is not None
    assert tracks.begins.tolist() == [0, 4]
