"""What viewers ask of a log and a layout, as Foxglove publishes it (`foxglove-sdk`: message schemas, layouts)."""

from __future__ import annotations

import json
import re
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.episodes.logs import policy, recorded, write
from trackmdp.episodes.layout import layout
from trackmdp.episodes.schema import SCHEMAS
from trackmdp.world.model import World

pytest.importorskip("foxglove", reason="needs the package foxglove-sdk")
pytest.importorskip("google.protobuf", reason="needs the package protobuf")

import foxglove.layouts as fl
from foxglove.messages import Grid
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory

WIDE = World(np.full((10, 10), 0.09), (2, 5), cost=0.2, safe_cost=2.0, t_max=2)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("log") / "wide.mcap"
    acting = policy(WIDE)
    return write(file, recorded(3, acting=acting, world=WIDE), acting=acting, world=WIDE)


def messages(log: Path, topic: str) -> list[dict[str, Any]]:
    with log.open("rb") as stream:
        return [json.loads(message.data) for _, _, message in make_reader(stream).iter_messages(topic)]


def published() -> Any:
    """Foxglove's own class of a `foxglove.Grid`."""
    files = descriptor_pb2.FileDescriptorSet.FromString(Grid.get_schema().data)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.Grid"))


def test_every_grid_is_one_of_foxgloves(log: Path) -> None:
    """No unknown key, every value of its type; and what is read from it is what was logged."""
    grid, steps = published(), messages(log, "/step")
    for said, step in zip(messages(log, "/grid"), steps, strict=True):
        time = said["timestamp"]
        # protobuf's own JSON writes times as text, Foxglove's as seconds and nanoseconds.
        stamp = datetime.fromtimestamp(time["sec"], UTC).strftime("%Y-%m-%dT%H:%M:%S")
        made = json_format.ParseDict(said | {"timestamp": f"{stamp}.{time['nsec']:09}Z"}, grid())
        rows = len(made.data) // made.row_stride
        assert (rows, made.column_count, made.row_stride, made.cell_stride) == (2, 5, 5 * made.cell_stride, 10)
        kinds = {1: np.dtype("u1"), 7: np.dtype("<f4")}  # foxglove.NumericType
        cell = np.dtype(
            {
                "names": [each.name for each in made.fields],
                "formats": [kinds[each.type] for each in made.fields],
                "offsets": [each.offset for each in made.fields],
                "itemsize": made.cell_stride,
            }
        )
        table = np.frombuffer(made.data, cell).reshape(rows, -1)[::-1].ravel()  # the first row is the lowest
        assert table["belief"].sum() == pytest.approx(0.9, abs=1e-5)
        assert np.flatnonzero(table["active"]).tolist() == step["active"]
        assert np.flatnonzero(table["target"]).tolist() == [each for each in [step["target"]] if each >= 0]


@pytest.mark.parametrize("topic", SCHEMAS)
def test_every_message_is_what_its_schema_says(log: Path, topic: str) -> None:
    found = messages(log, topic)
    assert found
    for said in found:
        check_json(said, SCHEMAS[topic][1], topic)


def check_json(value: Any, schema: dict[str, Any], place: str) -> None:
    """JSON Schema, as far as viewers read it: types, keys, items."""
    kinds = {"object": dict, "array": list, "string": str, "boolean": bool, "integer": int, "number": (int, float)}
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
        title = config.pop("foxglovePanelTitle", None)
        check(config, PANELS[name.split("!")[0]], name)
        if name.startswith("3D!"):
            assert title == config["topics"]["/grid"]["colorField"]
            check(config["topics"]["/grid"], fl.BaseRendererGridTopicSettings, name)
    shown = re.findall(r'"([^"]+![^"]+)"', json.dumps(made["layout"]))
    assert sorted(shown) == sorted(made["configById"])
    assert {"3D!belief", "3D!active", "3D!target"} <= set(shown)


def test_what_plots_show_is_in_the_messages(log: Path) -> None:
    text = json.dumps(layout(WIDE.size))
    paths = set(re.findall(r'"(/[a-z]+)\.([a-z_]+)"', text))
    assert len(paths) == 5
    for topic, key in paths:
        assert key in messages(log, topic)[0]
    assert {field["name"] for field in messages(log, "/grid")[0]["fields"]} == set(
        re.findall(r'"colorField": "(\w+)"', text)
    )


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
