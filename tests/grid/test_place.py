"""The place of a grid: by hand, to a position and back, and from a file of positions to a tracker."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import onnx
import pytest

import trackmdp as tm
from tests.helpers import small_world
from trackmdp.app.cli import main
from trackmdp.errors import UserError
from trackmdp.grid.place import Place
from trackmdp.policies.policy import Policy
from trackmdp.sensing.task import Task

CITY = Path(__file__).parents[1] / "data" / "city.csv"
PLACES = {
    "x, y": Place((100.0, -7.0), 3.7),
    "picture": Place((0.0, 0.0), 12.0, downwards=True),
    "UTM": Place((499_000.0, 5_200_000.0), 500.0, "EPSG:32632"),
    "south": Place((300_000.0, -4_000_000.0), 50.0, "EPSG:32660"),
    "Swiss": Place((2_600_000.0, 1_200_000.0), 1000.0, "EPSG:2056"),
}


def task(place: Place | None) -> Task:
    return Task((5, 7), cost=0.1, t_max=1, place=place)


@pytest.mark.parametrize("name", PLACES)
def test_the_middle_of_a_cell_is_in_that_cell(name: str) -> None:
    grid = task(PLACES[name])
    assert [grid.cell_of(*grid.place_of(cell)) for cell in range(35)] == list(range(35))


def test_by_hand() -> None:
    """Cells of 10 from (0, 0), 2 rows and 3 columns: with y up, row 0 is the upper one."""
    up, down = (Task((2, 3), cost=0.1, t_max=0, place=Place((0, 0), 10, None, d)) for d in (0, 1))
    assert (up.cell_of(25, 5), up.cell_of(0, 10), down.cell_of(25, 5)) == (5, 0, 2)
    assert (up.place_of(5), up.place_of(0), down.place_of(2)) == ((25, 5), (5, 15), (25, 5))
    for outside in ((30, 5), (-0.1, 5), (5, 20), (5, -1), (math.nan, 5), (5, math.inf)):
        with pytest.raises(UserError, match=r"^cell_of: x, y = .* is outside of the grid"):
            up.cell_of(*outside)


def test_latitude_comes_first() -> None:
    """On the central meridian of zone 32, 9 E, x is 500,000; the equator is y = 0, a degree north 110.6 km."""
    grid = task(Place((499_650.0, -50.0), 100.0, "EPSG:32632"))
    assert grid.cell_of(0, 9.0) == 4 * 7 + 3
    assert grid.cell_of(300 / 110_600, 9.0) == 7 + 3
    lat, lon = grid.place_of(3)
    assert (lat, lon) == pytest.approx((400 / 110_600, 9.0), rel=1e-3)
    with pytest.raises(UserError, match=r"^cell_of: lat, lon = 9, 0 is outside of the grid"):
        grid.cell_of(9.0, 0)


def test_without_a_place_nothing_is_guessed() -> None:
    for call in (lambda: task(None).cell_of(1, 1), lambda: small_world().place_of(1)):
        with pytest.raises(
            UserError, match=r"^(cell|place)_of: the place of the grid is not known"
        ):
            call()
    for cell in (35, 1.0, "x"):
        with pytest.raises(UserError, match=f"^place_of: cell={cell!r}: .* from 0 to 34$"):
            task(PLACES["UTM"]).place_of(cell)  # type: ignore[arg-type]
    for position in (("x", "y"), (None, 1), (10**400, 1)):
        with pytest.raises(UserError, match=r"^cell_of: \(.*, expected lat, lon as numbers$"):
            task(PLACES["UTM"]).cell_of(*position)
    with pytest.raises(UserError, match=r"^place: a dict, expected a Place or None$"):
        task({"cell": 1})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"cell": 0}, "place: corner (0.0, 0.0), cell 0.0; expected numbers, a cell above 0"),
        ({"corner": (0, math.nan)}, "place: corner (0.0, nan), cell 1.0; expected numbers"),
        ({"crs": "a.prj"}, "place: crs 'a.prj', expected a code such as EPSG:2056"),
    ],
)
def test_a_place_is_checked(given: dict[str, object], message: str) -> None:
    with pytest.raises(UserError) as caught:
        Place(**({"corner": (0, 0), "cell": 1} | given))  # type: ignore[arg-type]
    assert str(caught.value).startswith(message)


def degrees(file: Path) -> Path:
    """The city at 48 N, 11 E, in degrees."""
    number, time, x, y = np.loadtxt(CITY, delimiter=",", skiprows=1).T
    table = np.stack([number, time, 48 + y / 111_208, 11 + x / 74_627], axis=1)
    np.savetxt(file, table, "%.7f", ",", header="id,time,lat,lon", comments="")
    return file


@pytest.mark.parametrize("geographic", [False, True])
def test_every_report_of_a_file_is_in_the_cell_that_its_track_has(
    geographic: bool, tmp_path: Path
) -> None:
    """The city reports every 5 s, so that each first cell of a target is that of its first report."""
    file = degrees(tmp_path / "gps.csv") if geographic else CITY
    world = tm.load_tracks(file, (22, 19), step=5, cell=50, t_max=1, cost=0.1)
    assert world.place is not None
    assert world.place.crs == ("EPSG:32632" if geographic else None)
    ids, _, first, second = np.loadtxt(file, delimiter=",", skiprows=1).T
    begins = np.flatnonzero(np.diff(ids, prepend=-1))
    ids_as_texts = np.unique([line.split(",")[0] for line in file.read_text().splitlines()[1:]])
    parts = (world.tracks, world.validation, world.held_out)
    cells = {
        int(name): int(part.cells[at])
        for part in parts
        for name, at in zip(part.names[::-1], part.first[:-1][::-1], strict=True)
    }
    compared = 0
    for at in begins:
        name = int(np.flatnonzero(ids_as_texts.astype(float) == ids[at])[0])
        if name in cells:
            assert world.cell_of(first[at], second[at]) == cells[name]
            compared += 1
    assert compared > 600


def test_from_positions_to_a_tracker(tmp_path: Path) -> None:
    """The place goes with the run, its policy, its summary and its exports."""
    world = tm.load_tracks(degrees(tmp_path / "gps.csv"), (18, 15), step=5, cell=50, t_max=1)
    run = tm.train(world, "model_based", folder=tmp_path / "run")
    assert world.place is not None
    assert run.summary["place"] == world.place.facts()
    assert tm.load_run(tmp_path / "run").summary["place"] == world.place.facts()
    policy = Policy.load(tmp_path / "run/policy.npz")
    assert policy.task.place == run.policy.task.place == world.place
    at = world.place_of(100)
    tracker = policy.tracker(at=at)
    assert (tracker.cell, tracker.sensors()) == (100, policy.tracker(100).sensors())
    tracker.report(None)
    tracker.sensors()
    tracker.report(None)
    tracker.sensors()
    tracker.report(at=world.place_of(101))
    assert tracker.cell == 101
    for form in ("onnx", "sets"):
        assert main(["export", f"run={tmp_path / 'run'}", f"format={form}", "quiet=true"]) == 0
    about = {one.key: one.value for one in onnx.load(tmp_path / "run/policy.onnx").metadata_props}
    assert (about["crs"], about["rows"], about["columns"]) == ("EPSG:32632", "18", "15")
    from pyproj import Transformer

    x, y = Transformer.from_crs("EPSG:4326", about["crs"], always_xy=True).transform(*at[::-1])
    known = {"x": x, "y": y}
    exec(about["cell_of"], {"floor": math.floor}, known)
    assert known["cell"] == 100
    written = json.loads((tmp_path / "run/sets.json").read_text(encoding="utf-8"))
    assert written["place"] == world.place.facts()


@pytest.mark.parametrize("name", PLACES)
def test_the_formula_is_that_of_the_cells(name: str) -> None:
    place = PLACES[name]
    recipe = place.recipe((5, 7))
    for cell in range(35):
        across, up = cell % 7, cell // 7 if place.downwards else 4 - cell // 7
        left, low = place.corner
        known = {"x": left + (across + 0.99) * place.cell, "y": low + (up + 0.01) * place.cell}
        exec(recipe["cell_of"], {"floor": math.floor}, known)
        assert known["cell"] == cell == place.cells(known["x"], known["y"], (5, 7))


def test_mistakes_with_positions_end_in_one_line() -> None:
    policy = Policy.all_on(task(PLACES["x, y"]))
    tracker = policy.tracker(at=(101, -6))
    tracker.sensors()
    for mistake, message in (
        (lambda: policy.tracker(3, at=(101, -6)), "tracker: cell=3 and at=(101, -6), expected one"),
        (lambda: policy.tracker(), "tracker: no cell and no at, expected the first detection"),
        (lambda: policy.tracker(at=(0, 0)), "cell_of: x, y = 0, 0 is outside of the grid"),
        (lambda: policy.tracker(at=3), "tracker: at=3, expected two numbers"),
        (lambda: tracker.report(at=(1, 2, 3)), "report: at=(1, 2, 3), expected two numbers"),
        (lambda: tm.Tracker(3, 0), "tracker: a int, expected a policy of one target, or its file"),
        (lambda: tracker.report(at=(0, 0)), "cell_of: x, y = 0, 0 is outside of the grid"),
        (lambda: Policy.all_on(small_world()).tracker(at=(0, 0)), "cell_of: the place of the grid"),
    ):
        with pytest.raises(UserError) as caught:
            mistake()
        assert str(caught.value).startswith(message)
