"""A policy as GeoJSON: squares where the cells lie, with their values and sensors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from trackmdp.app.cli import main
from trackmdp.errors import UserError
from trackmdp.policies.geojson import map_features

ON_A_MAP = {"cell": 500.0, "origin": (8.5, 47.0), "crs": "EPSG:2056"}


@pytest.fixture(scope="module")
def world() -> tm.World:
    made = tm.make_world("drift", size=(3, 4), t_max=1, **ON_A_MAP)
    assert isinstance(made, tm.World)
    return made


def test_every_cell_is_a_square_with_its_value_and_its_sensors(
    world: tm.World, tmp_path: Path
) -> None:
    solution = tm.solve(world)
    file = tm.export(solution, tmp_path / "map.geojson")
    features = json.loads(file.read_text())["features"]
    assert [each["properties"]["cell"] for each in features] == list(range(12))
    for cell, each in enumerate(features):
        about, (ring,) = each["properties"], each["geometry"]["coordinates"]
        assert about["value"] == solution.value[cell]
        for n in (0, 1):
            expected = np.flatnonzero(solution.table.dense()[cell, n]).tolist()
            assert (about[f"on_{n}"], about[f"count_{n}"]) == (expected, len(expected))
        # Longitude first, closed, and its middle is the cell's.
        assert ring[0] == ring[-1] and len(ring) == 5
        lat, lon = np.mean(ring[:-1], axis=0)[::-1]
        assert world.cell_of(lat, lon) == cell
        assert (lat, lon) == pytest.approx(world.place_of(cell), abs=1e-6)
        x, y = np.array(ring[:-1]).T  # counterclockwise: a positive area
        assert np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0


def test_across_180_degrees_the_squares_lie_side_by_side() -> None:
    place = ON_A_MAP | {"origin": (179.99, -17.0), "crs": "EPSG:32660"}
    policy = tm.solve(tm.make_world("drift", size=(3, 4), **place), "qmdp").policy
    rings = [each["geometry"]["coordinates"][0] for each in map_features(policy)["features"]]
    lon = np.array(rings)[..., 0]
    assert lon.max() > 180 and np.ptp(lon) < 0.03


def test_the_command_writes_the_same(tmp_path: Path) -> None:
    words = ["grid.size=4", "grid.cell=500", "grid.origin=[8.5,47.0]", "grid.crs=EPSG:2056"]
    few = ["algo=model_based", "algo.total_frames=2000", "algo.frames_per_batch=1000"]
    folder = f"hydra.run.dir={tmp_path}"
    assert main(["train", *words, *few, "algo.envs=50", "quiet=true", folder]) == 0
    assert main(["export", f"run={tmp_path}", "format=geojson", "quiet=true"]) == 0
    run = tm.load_run(tmp_path)
    written = json.loads((tmp_path / "policy.geojson").read_text())
    found = map_features(run.policy, run.evaluation.value)
    assert [each["geometry"] for each in written["features"]] == json.loads(
        json.dumps([each["geometry"] for each in found["features"]])
    )
    values = [[each["properties"]["value"] for each in of["features"]] for of in (written, found)]
    assert values[0] == pytest.approx(values[1])


def test_a_cell_without_a_value_has_null(world: tm.World) -> None:
    features = map_features(tm.Policy.none(world), np.full(12, np.nan))["features"]
    assert {each["properties"]["value"] for each in features} == {None}
    assert all(each["properties"]["on_0"] == [] for each in features)


@pytest.mark.usefixtures("little_search")
def test_a_memory_is_shown_as_at_the_start() -> None:
    world = tm.make_world("heading", size=3, memory="displacement", t_max=0, **ON_A_MAP)
    policy = tm.solve(world).policy
    features = map_features(policy)["features"]
    assert [each["properties"]["on_0"] for each in features] == [
        policy.tracker(cell).sensors() for cell in range(9)
    ]


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ({}, "no latitude and longitude, expected a policy that was trained or solved with"),
        ({"cell": 5.0, "origin": (0.0, 0.0)}, "no latitude and longitude"),
    ],
)
def test_without_latitude_and_longitude_there_is_no_map(
    place: dict[str, object], message: str, tmp_path: Path
) -> None:
    world = tm.make_world("drift", size=3, **place)
    with pytest.raises(UserError, match=message):
        tm.export(tm.Policy.none(world), tmp_path / "a.geojson")


def test_the_command_refuses_before_it_values_the_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["grid.size=3", "algo.total_frames=2000", "algo.frames_per_batch=1000", "algo.envs=50"]
    assert main(["train", *few, "quiet=true", f"hydra.run.dir={tmp_path}"]) == 0
    monkeypatch.setattr("trackmdp.app.commands.export.value_of", None)  # fails where it is called
    assert main(["export", f"run={tmp_path}", "format=geojson"]) == 2
    assert "no latitude and longitude" in capsys.readouterr().err


def test_what_cannot_be_exported_is_one_line(world: tm.World, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="draws its sets"):
        map_features(tm.Policy.random_k(world, 2))
    with pytest.raises(UserError, match=r"a\.pkl, expected a file that ends with \.onnx, \.pt2"):
        tm.export(tm.Policy.none(world), tmp_path / "a.pkl")
    with pytest.raises(UserError, match="a World, expected a policy of one target"):
        tm.export(world, tmp_path / "a.onnx")
    several = tm.solve(tm.Group([world, world]))
    with pytest.raises(UserError, match="export: a Merged, expected a policy of one target"):
        tm.export(several, tmp_path / "a.onnx")


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ({"origin": (8.5, 47.0)}, "grid.cell: missing"),
        ({"cell": 500.0, "crs": "EPSG:2056"}, "grid.origin: missing"),
        ({"cell": 500.0, "origin": (8.5, 147.0), "crs": "EPSG:2056"}, "grid.origin=[8.5, 147.0]"),
        ({"cell": 500.0, "origin": (8.5, 47.0), "crs": "EPSG:4326"}, "grid.crs=EPSG:4326"),
        ({"cell": 500.0, "origin": (8.5,)}, "grid.origin=[8.5]"),
    ],
)
def test_a_place_by_hand_is_checked(place: dict[str, object], message: str) -> None:
    with pytest.raises(UserError) as caught:
        tm.make_world("drift", size=3, **place)
    assert str(caught.value).startswith(message)


def test_recorded_cells_take_a_place_by_hand(tmp_path: Path) -> None:
    file = tmp_path / "cells.csv"
    rows = [f"{track},{cell}" for track in range(10) for cell in (0, 1, 2, 2, 1)]
    file.write_text("\n".join(["track,cell", *rows]))
    tracks = tm.load_tracks(file, 3, cost=0.1, **ON_A_MAP)
    assert tracks.cell_of(*tracks.place_of(7)) == 7
