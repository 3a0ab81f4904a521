"""Recorded tracks from Python: the city's, cells, clocks, and what does not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import trackmdp as tm
from tests.helpers import later
from tests.recordings.test_gridding import cells, made, seen
from tests.tracks import digest_of
from trackmdp.errors import UserError
from trackmdp.policies.saved import packed
from trackmdp.recordings.tracks import Recorded

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


@pytest.mark.parametrize("geographic", [True, *later([False])])
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
        UserError, match=r"^kernel\.step=50: only for positions; kernel\.path=.* holds cells$"
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
