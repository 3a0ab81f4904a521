"""A policy as a file that runs without this package, or lies on a map.

A deterministic policy is a table: the sensors to switch on n steps after the target was detected in cell x.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from trackmdp import __version__
from trackmdp.arrays.types import Array, BoolArray
from trackmdp.durable import write_bytes
from trackmdp.errors import UserError, output_of, require
from trackmdp.machine import check_free
from trackmdp.policies.forms import adapted
from trackmdp.policies.geojson import map_features
from trackmdp.policies.saved import listable
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task

_LARGEST = 2**31  # entries, a byte each
_COPIES = 4  # of the table at the least, while a package checks and writes it; onnx makes two more


def export(policy: Any, file: str | Path, *, value: Array | None = None, label: str = "") -> Path:
    """Write a policy in the format of the file's ending, and return its path.

    `.onnx` and `.pt2` (`torch.export`) take int64 `last_cell` `[B]` and `steps_since_detection` `[B]` and give bool
    `action` `[B, S]`: the sensors to switch on, all of them once the target has been missed more than t_max times.
    Where the policy remembers more than the cell, the input `key` stands in place of `last_cell`; the metadata
    `key_start` and `key_next` are its formulas (`KeySpace.recipe`). Where the place of the grid is known, they also
    hold `crs`, `corner`, `cell_side`, and in `cell_of` the formula of the cell of projected x and y (`Place.recipe`).
    `absent` are the numbers of sensors that do not exist.
    `.json` holds the sets as lists (`PolicyTable.as_lists`), `.geojson` cells on a map (`trackmdp.policies.geojson`).

    Args:
        policy: a policy, a `Run` or a `Solution`.
        file: to write.
        value: `[M]` V(x) for the map; by default the run's or the solution's.
        label: name of the policy, for the metadata.

    Raises:
        UserError: the file cannot be written there, its ending is unknown, a package is missing, the policy draws its
            sets, is too large or exceeds the budget.
    """
    place, table = output_of(file, "export"), adapted(None, policy)
    if not isinstance(table, PolicyTable):
        held = type(getattr(policy, "policy", policy)).__name__
        raise UserError(
            f"export: a {held}, expected a policy of one target: a Policy, a Run or a Solution"
        )
    table.check_fits(table.task)
    if value is None:
        value = getattr(getattr(policy, "evaluation", None), "value", None)
    if place.suffix not in WRITERS:
        raise UserError(
            f"export: {place.name}, expected a file that ends with {', '.join(WRITERS)}"
        )
    about = {"trackmdp": __version__, "policy": label} | _facts(table.task)
    write_bytes(place, WRITERS[place.suffix](table, value, about))
    return place


def _facts(task: Task) -> dict[str, str]:
    """The metadata of a policy's task."""
    facts = {"rows": str(task.rows), "columns": str(task.columns), "t_max": str(task.t_max)}
    if task.place is not None:
        facts |= task.place.recipe(task.size) | {"place": json.dumps(task.place.facts())}
    if not task.available.all():
        facts["absent"] = json.dumps(np.flatnonzero(~task.available).tolist())
    if task.coverage is not None:
        facts["footprints"] = json.dumps(task.coverage.as_lists())
    if task.keyed:
        keys = task.keys
        facts |= {"memory": keys.memory, "clip": str(keys.clip), "modes": str(keys.modes)}
        facts |= {"classes": str(keys.num_classes)} | keys.recipe()
    return facts


def _inputs(task: Task) -> tuple[str, str]:
    """The names of the inputs."""
    return "key" if task.keyed else "last_cell", "steps_since_detection"


def to_torch(policy: PolicyTable, _: Array | None, about: dict[str, str]) -> bytes:
    """A program for `torch.export.load`; `about` stands beside it as text."""
    # Traced with 2 states: a batch of 1 would be taken for a constant.
    batch = torch.export.Dim("batch")
    states = tuple(torch.zeros(2, dtype=torch.int64) for _ in _inputs(policy.task))
    table = (_KeyTable if policy.task.keyed else _Table)(policy)
    program = torch.export.export(table, states, dynamic_shapes=({0: batch}, {0: batch}))
    buffer = io.BytesIO()
    text = "\n".join(f"{key}: {value}" for key, value in about.items())
    torch.export.save(program, buffer, extra_files={"about.txt": text})
    return buffer.getvalue()


def to_onnx(policy: PolicyTable, _: Array | None, about: dict[str, str]) -> bytes:
    """An ONNX model that looks the action up; `about` are its metadata.

    Raises:
        UserError: the package onnx is not installed.
    """
    require("onnx", "onnx", "format=onnx")
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    table, inputs = _table(policy), _inputs(policy.task)
    # table[last_cell, min(n, last_row)]: GatherND wants its indices as one `[B, 2]` array, which the nodes put
    # together.
    constants = {"table": table, "last_row": np.array(table.shape[1] - 1), "column": np.array([1])}
    nodes = [
        helper.make_node("Min", ["steps_since_detection", "last_row"], ["row"]),
        helper.make_node("Unsqueeze", [inputs[0], "column"], ["cells"]),
        helper.make_node("Unsqueeze", ["row", "column"], ["rows"]),
        helper.make_node("Concat", ["cells", "rows"], ["index"], axis=1),
        helper.make_node("GatherND", ["table", "index"], ["action"]),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(name, TensorProto.INT64, ["batch"]) for name in inputs],
        [helper.make_tensor_value_info("action", TensorProto.BOOL, ["batch", table.shape[2]])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    opsets = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8, producer_name="trackmdp")
    helper.set_model_props(model, about)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _to_sets(policy: PolicyTable, *_: object) -> bytes:
    if not policy.deterministic:
        raise UserError("export: the policy draws its sets at random: no list has them")
    if not listable(policy):
        raise UserError(
            "export: too many sets for a .json; `trackmdp export format=sets` writes them as .npz"
        )
    return json.dumps(policy.as_lists()).encode()


WRITERS: dict[str, Callable[[PolicyTable, Array | None, dict[str, str]], bytes]] = {
    ".onnx": to_onnx,
    ".pt2": to_torch,
    ".json": _to_sets,
    ".geojson": lambda policy, value, _: json.dumps(map_features(policy, value)).encode(),
}
"""Ending of a file -> its content, of a policy, its value and its metadata."""


class _Table(nn.Module):
    """Looks the action up."""

    table: Tensor

    def __init__(self, policy: PolicyTable) -> None:
        super().__init__()
        self.register_buffer("table", torch.as_tensor(_table(policy)))

    def forward(self, last_cell: Tensor, steps_since_detection: Tensor) -> Any:
        return self.table[last_cell, steps_since_detection.clamp(max=self.table.shape[1] - 1)]


class _KeyTable(_Table):
    """Looks the action of a key up; the names of the arguments become those of the program's inputs."""

    def forward(self, key: Tensor, steps_since_detection: Tensor) -> Any:
        return super().forward(key, steps_since_detection)


def _table(policy: PolicyTable) -> BoolArray:
    """`[keys, t_max+2, S]`, the sets and after them the forced safe action.

    Raises:
        UserError: it is too large to be written out, or for the free memory.
    """
    task = policy.task
    if (size := task.num_keys * (task.num_choices + 1) * task.total_sensors) > _LARGEST:
        raise UserError(
            f"export: a table of {size:,} entries, expected at most {_LARGEST:,}; format=sets takes less"
        )
    check_free(f"export: a table of {size:,} entries", _COPIES * size)
    sets = policy.dense()
    # Row t_max + 1 is all sensors on: the file's reader then needs no rule for the forced action.
    every = np.broadcast_to(task.available, sets[:, :1].shape)
    return np.concatenate([sets, every], axis=1)
