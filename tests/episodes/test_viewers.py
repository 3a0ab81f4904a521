"""What viewers ask of a log and a layout, as Foxglove publishes it (`foxglove-sdk`: message schemas, layouts)."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.episodes.logs import WORLD, policy, recorded, write
from tests.helpers import limited
from trackmdp.episodes import grids
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.grids import WHOLE_CELLS
from trackmdp.episodes.layouts import layout
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.schema import schemas_of
from trackmdp.episodes.simulate import simulate
from trackmdp.motion.kernels import random_walk
from trackmdp.policies.policy import Policy
from trackmdp.world.make import make_world
from trackmdp.world.model import World

pytest.importorskip("foxglove", reason="needs the package foxglove-sdk")
pytest.importorskip("google.protobuf", reason="needs the package protobuf")

import foxglove.layouts as fl
from foxglove.messages import Grid
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

WALK = World(
    random_walk((3, 4), stay=0.4, diagonal=False, exit_probability=0.1, border="clip"),
    (3, 4),
    cost=0.2,
    t_max=1,
)
WIDE = World(np.full((10, 10), 0.09), (2, 5), cost=0.2, safe_cost=2.0, t_max=2)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("log") / "wide.mcap"
    acting = policy(WIDE)
    return write(file, recorded(3, acting=acting, world=WIDE), acting=acting, world=WIDE)


def messages(log: Path, topic: str) -> list[dict[str, Any]]:
    with log.open("rb") as stream:
        return [
            json.loads(message.data) for _, _, message in make_reader(stream).iter_messages(topic)
        ]


LAYERS = ("/grid", "/active", "/target")


def drawn(said: dict[str, Any], size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Field -> what a viewer draws in each of our cells; Foxglove's class refuses unknown keys and other types."""
    made = parsed(said, Grid, "foxglove.Grid")
    rows, columns, side = len(made.data) // made.row_stride, made.column_count, made.cell_size.x
    assert (made.row_stride, made.cell_size.y) == (columns * made.cell_stride, side)
    kinds = {1: np.dtype("u1"), 7: np.dtype("<f4")}  # foxglove.NumericType
    cell = np.dtype(
        {
            "names": [each.name for each in made.fields],
            "formats": [kinds[each.type] for each in made.fields],
            "offsets": [each.offset for each in made.fields],
            "itemsize": made.cell_stride,
        }
    )
    table = np.frombuffer(made.data, cell).reshape(rows, columns)
    found = {name: np.zeros(size, table.dtype[name]) for name in cell.names or ()}
    for row, column in np.ndindex(
        rows, columns
    ):  # the first row is the lowest; a place in x, y is that of a corner
        x = made.pose.position.x + side * (column + 0.5)
        y = made.pose.position.y + side * (row + 0.5)
        assert side == 1 or (x % 1, y % 1) == (0.5, 0.5)
        for name, whole in found.items():
            whole[int(size[0] - y), int(x)] = table[name][row, column]
    return {name: whole.ravel() for name, whole in found.items()}


def parsed(said: dict[str, Any], kind: Any, name: str) -> Any:
    """A message as Foxglove's own class of it."""
    files = descriptor_pb2.FileDescriptorSet.FromString(kind.get_schema().data)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))()
    return json_format.ParseDict(with_times(said), made)


def with_times(said: Any) -> Any:
    """Times as text, as protobuf's own JSON has them; Foxglove's has seconds and nanoseconds."""
    if isinstance(said, list):
        return [with_times(each) for each in said]
    if not isinstance(said, dict):
        return said
    if said.keys() == {"sec", "nsec"}:
        stamp = datetime.fromtimestamp(said["sec"], UTC).strftime("%Y-%m-%dT%H:%M:%S")
        return f"{stamp}.{said['nsec']:09}Z"
    return {key: with_times(each) for key, each in said.items()}


@pytest.mark.parametrize("whole_cells", [WHOLE_CELLS, 9])
def test_what_is_drawn_is_what_was_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole_cells: int
) -> None:
    """All layers over each other, each above the one before; a large grid's belief without the part where it is 0."""
    monkeypatch.setattr(grids, "WHOLE_CELLS", whole_cells)
    acting = policy(WALK)
    episodes = recorded(8, acting=acting, world=WALK)
    file = write(tmp_path / "a.mcap", episodes, acting=acting, world=WALK)
    every = [messages(file, topic) for topic in LAYERS]
    assert [each[0]["pose"]["position"]["z"] for each in every] == [0, 0.01, 0.02]
    steps = [(episode, t) for episode in episodes for t in range(len(episode))]
    counts = [each["n_active"] for each in messages(file, "/step")]
    for (episode, t), count, *layers in zip(steps, counts, *every, strict=True):
        shown = {name: cells for layer in layers for name, cells in drawn(layer, WALK.size).items()}
        assert np.array_equal(shown["belief"], episode.belief[t])  # type: ignore[index]
        assert np.array_equal(shown["policy"], episode.probability[t])  # type: ignore[index]
        on = episode.action[t] & ~episode.forced(WALK.t_max)[t]
        assert np.array_equal(shown["active"], on) and count == on.sum()
        assert np.flatnonzero(shown["target"]).tolist() == [
            each for each in [episode.target[t]] if each < 12
        ]
    assert {len(each["data"]) for each in every[2]} == {4}  # one byte in base64
    sizes = {len(each["data"]) for each in every[0]}
    assert max(sizes) == 128 and (min(sizes) < 128) == (
        whole_cells < 12
    )  # 12 cells of 8 bytes in base64
    with EpisodeReader(file) as reader:
        assert all(
            first_difference(a, b) is None for a, b in zip(episodes, reader.episodes(), strict=True)
        )


def test_the_messages_of_a_large_grid_are_as_large_as_what_is_known() -> None:
    """300 x 300 cells of 8 bytes would be 960,000 characters; a target that moves by one cell is within 5 x 5."""
    world = make_world("random_walk", size=300, cost=0.2, t_max=1, safe_cost=10.0)
    [episode] = simulate(limited(world, 6), Policy.none(world), 1, seed=0).complete()
    for layers in grids.grid_messages(episode, world.size, 0, episode.action):
        assert len(layers["/grid"]) < 1000
        assert max(len(text) for text in layers.values()) < 1000


def test_the_part_that_viewers_look_at_moves_by_nine_rows_within_the_grid() -> None:
    """60 x 10 cells, of which 25 x 10 are looked at; rows are counted from the top, y from the bottom."""
    world = make_world("random_walk", size=(60, 10), cost=0.2, t_max=1, safe_cost=10.0)
    episodes = simulate(limited(world, 6), Policy.none(world), 20, seed=0).complete()
    episode = next(each for each in episodes if len(each) == 6)
    target = np.array([0, 30, 35, 36, 59, 60]) * 10  # the last has exited
    parts = [
        json.loads(layers["/part"])["translation"]
        for layers in grids.grid_messages(
            replace(episode, target=target), world.size, 0, episode.action
        )
    ]
    assert [part["y"] for part in parts] == [60 - 12.5, 60 - 31.5, 60 - 31.5, 60 - 40.5, 12.5, 12.5]
    assert {(part["x"], part["z"]) for part in parts} == {(5, 0)}


@pytest.mark.parametrize(
    "place", [{"x": -1}, {"x": 4}, {"y": -1}, {"y": 2}, {"x": 0.5}, {"x": None}]
)
def test_a_grid_that_lies_outside_is_damage(place: dict[str, Any]) -> None:
    [episode] = recorded(1, acting=policy(WALK), world=WALK)
    every = [
        json.loads(layers["/grid"])
        for layers in grids.grid_messages(episode, WALK.size, 0, episode.action)
    ]
    every[0]["pose"]["position"] |= place
    # a single column fits into an empty slice as well
    every[1] |= {"column_count": 1, "data": b64encode(bytes(24)).decode(), "pose": every[0]["pose"]}
    for wrong in every[:2]:
        with pytest.raises((ValueError, TypeError)):
            grids.read_grids([json.dumps(wrong).encode()], WALK.size)


@pytest.mark.parametrize("topic", schemas_of(WORLD))
def test_every_message_is_what_its_schema_says(log: Path, topic: str) -> None:
    found = messages(log, topic)
    assert found
    for said in found:
        check_json(said, schemas_of(WORLD)[topic][1], topic)


def check_json(value: Any, schema: dict[str, Any], place: str) -> None:
    """JSON Schema, as far as viewers read it: types, keys, items."""
    kinds = {
        "object": dict,
        "array": list,
        "string": str,
        "boolean": bool,
        "integer": int,
        "number": (int, float),
    }
    assert isinstance(value, kinds[schema["type"]]), place
    assert isinstance(value, bool) == (schema["type"] == "boolean"), place
    if isinstance(value, dict):
        assert set(value) == set(schema["properties"]), place
        for key, part in value.items():
            check_json(part, schema["properties"][key], f"{place}.{key}")
    for part in value if isinstance(value, list) else ():
        check_json(part, schema["items"], f"{place}[]")


PANELS = {
    "3D": fl.ThreeDeeConfig,
    "Plot": fl.PlotConfig,
    "StateTransitions": fl.StateTransitionsConfig,
    "RawMessages": fl.RawMessagesConfig,
}


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (64, 64)])
def test_every_panel_is_one_of_foxgloves(size: tuple[int, int]) -> None:
    """No unknown setting, every value of its type; every field that colours a map is in the messages."""
    made = layout(size)
    for name, config in made["configById"].items():
        titles = {config.pop(f"{viewer}PanelTitle", None) for viewer in ("foxglove", "lichtblick")}
        assert None not in titles and len(titles) == 1
        check(config, PANELS[name.split("!")[0]], name)
        for layer in config.get("topics", {}).values():
            check(layer, fl.BaseRendererGridTopicSettings, name)
    # Lichtblick stays blank without a speed, and draws no line at any other time
    assert made["playbackConfig"] == {"speed": 0.2}
    assert set(re.findall(r'"timestampMethod": "(\w+)"', json.dumps(made))) == {"receiveTime"}
    shown = re.findall(r'"([^"]+![^"]+)"', json.dumps(made["layout"]))
    assert sorted(shown) == sorted(made["configById"])


@pytest.mark.parametrize("size", [(1, 1), (2, 5), (64, 64), (70, 30)])
def test_lines_surround_all_cells_and_none_outside(size: tuple[int, int]) -> None:
    rows, columns = size
    for panel in layout(size)["configById"].values():
        within = np.zeros(size, bool)
        for lines in panel.get("layers", {}).values():
            assert (lines["frameId"], lines["divisions"]) == ("grid", lines["size"])
            left, low = (middle - lines["size"] / 2 for middle in lines["position"][:2])
            assert (
                min(left, low) >= 0
                and left + lines["size"] <= columns
                and low + lines["size"] <= rows
            )
            assert left % 1 == low % 1 == 0
            within[int(low) : int(low) + lines["size"], int(left) : int(left) + lines["size"]] = (
                True
            )
        assert within.all() == ("layers" in panel)


@pytest.mark.parametrize(("size", "distance"), [((10, 4), 12), ((300, 300), 30)])
def test_cameras_look_at_the_part_and_see_all_of_it(size: tuple[int, int], distance: float) -> None:
    cameras = [panel for panel in layout(size)["configById"].values() if "cameraState" in panel]
    assert [panel["cameraState"]["distance"] for panel in cameras] == [distance, distance]
    assert {panel["followTf"] for panel in cameras} == {"part"}


def test_what_panels_show_is_in_the_messages(log: Path) -> None:
    made = layout(WIDE.size)
    paths = set(re.findall(r'"(/[a-z]+)\.([a-z_]+)"', json.dumps(made)))
    assert len(paths) == 4
    for topic, key in paths:
        assert key in messages(log, topic)[0]
    maps = [panel["topics"] for panel in made["configById"].values() if "topics" in panel]
    assert [panel["/grid"]["colorField"] for panel in maps] == ["belief", "policy"]
    for topics in maps:
        assert tuple(topics) == LAYERS
        for topic, layer in topics.items():
            assert layer["colorField"] in {
                field["name"] for field in messages(log, topic)[0]["fields"]
            }


def check(value: Any, kind: Any, place: str) -> None:
    """Whether a value of JSON is of a Python type, of one of Foxglove's classes, or of one type of a union."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        assert any(fits(value, part) for part in parts), f"{place}: {value}"
    elif origin is Literal:
        assert value in parts, f"{place}: {value}"
    elif origin in (list, dict, tuple):
        assert isinstance(value, list if origin is tuple else origin), place
        assert origin is not tuple or len(value) == len(parts), place
        for each in value.values() if origin is dict else value:
            check(each, parts[-1], place)
    elif is_dataclass(kind):
        hints, known = get_type_hints(kind, vars(fl)), {field.name for field in fields(kind)}
        for key, part in value.items():
            name = re.sub(r"([A-Z])", r"_\1", key).lower()
            assert name in known, f"{place}: unknown setting {key}"
            check(part, hints[name], f"{place}.{key}")
    else:
        assert isinstance(value, (int, float) if kind is float else kind), f"{place}: {value}"


def fits(value: Any, kind: Any) -> bool:
    try:
        check(value, kind, "")
    except (AssertionError, AttributeError, TypeError):
        return False
    return True
