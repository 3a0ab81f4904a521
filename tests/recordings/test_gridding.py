"""From positions to cells, by hand: sampled, projected, put on the grid, cut, and counted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trackmdp.errors import UserError
from trackmdp.recordings.gridding import Gridding, said, to_tracks
from trackmdp.recordings.positions import Positions, table_of
from trackmdp.recordings.tracks import Tracks


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
            (1, 10, 0, 0),
        ),
        exits=False,
    )
    assert cells(tracks) == [[5], [5], [3, 3]]
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
        match=r"^here: no track of at least 4 cells; 7 reports read, .*, 5 columns that they span$",
    ):
        made(positions, shortest=4)


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
