"""`export`: a learned policy as a file that runs without this package.

A deterministic policy is a table: the sensors to switch on n steps after the target was detected in cell x.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from trackmdp import __version__
from trackmdp.config import ExportConfig
from trackmdp.durable import write_bytes
from trackmdp.errors import UserError, require
from trackmdp.policies.policy import Policy
from trackmdp.policies.saved import sets_name, write_sets
from trackmdp.training.display import make_console
from trackmdp.training.run import trained
from trackmdp.world.model import BoolArray

_INPUTS = ("last_cell", "steps_since_detection")
_LARGEST = 2**31  # entries, a byte each


def run(cfg: ExportConfig, folder: Path) -> None:
    """Write `policy.pt2`, `policy.onnx` or `sets.json` to `folder`.

    The first two take int64 `last_cell` `[B]` and `steps_since_detection` `[B]` and give bool `action` `[B, M]`: the
    sensors to switch on, all of them once the target has been missed more than t_max times. Where the policy remembers
    more than the cell, its key (`trackmdp.world.memory`) stands in place of `last_cell`.

    Raises:
        UserError: there is no such run, or a package that `cfg.format` needs is missing.
    """
    world, policy, subject = trained(cfg.run, torch.device("cpu"), best=cfg.checkpoint == "best")
    task = world.task
    about = {"trackmdp": __version__, "policy": subject, "grid_size": str(task.rows), "t_max": str(task.t_max)}
    if task.keyed:
        about |= {"memory": task.memory, "clip": str(task.clip), "classes": str(task.keys.num_classes)}
    if cfg.format == "sets":
        file = folder / sets_name(task)
        write_sets(folder, policy)
    else:
        name, written = ("policy.onnx", to_onnx) if cfg.format == "onnx" else ("policy.pt2", to_torch)
        file = folder / name
        write_bytes(file, written(policy, about))
    make_console(cfg.quiet).print(f"{subject} -> {file}")


def to_torch(policy: Policy, about: dict[str, str]) -> bytes:
    """What `torch.export.load` reads; `about` stands beside it as text."""
    # Traced with 2 states: a batch of 1 would be taken for a constant.
    batch = torch.export.Dim("batch")
    states = tuple(torch.zeros(2, dtype=torch.int64) for _ in _INPUTS)
    program = torch.export.export(_Table(policy), states, dynamic_shapes=({0: batch}, {0: batch}))
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={"about.txt": "\n".join(f"{k}: {v}" for k, v in about.items())})
    return buffer.getvalue()


def to_onnx(policy: Policy, about: dict[str, str]) -> bytes:
    """An ONNX model that looks the action up; `about` are its metadata.

    Raises:
        UserError: the package onnx is not installed.
    """
    require("onnx", "onnx", "format=onnx")
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    table = _table(policy)
    # table[last_cell, min(n, last_row)]: GatherND wants its indices as one `[B, 2]` array, which the nodes put
    # together.
    constants = {"table": table, "last_row": np.array(table.shape[1] - 1), "column": np.array([1])}
    nodes = [
        helper.make_node("Min", ["steps_since_detection", "last_row"], ["row"]),
        helper.make_node("Unsqueeze", ["last_cell", "column"], ["cells"]),
        helper.make_node("Unsqueeze", ["row", "column"], ["rows"]),
        helper.make_node("Concat", ["cells", "rows"], ["index"], axis=1),
        helper.make_node("GatherND", ["table", "index"], ["action"]),
    ]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(name, TensorProto.INT64, ["batch"]) for name in _INPUTS],
        [helper.make_tensor_value_info("action", TensorProto.BOOL, ["batch", table.shape[2]])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    opsets = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=8, producer_name="trackmdp")
    helper.set_model_props(model, about)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


class _Table(nn.Module):
    """Looks the action up."""

    table: Tensor

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.register_buffer("table", torch.as_tensor(_table(policy)))

    def forward(self, last_cell: Tensor, steps_since_detection: Tensor) -> Any:
        return self.table[last_cell, steps_since_detection.clamp(max=self.table.shape[1] - 1)]


def _table(policy: Policy) -> BoolArray:
    """`[keys, t_max+2, M]`, the sets and after them the forced safe action.

    Raises:
        UserError: it is too large to be written out.
    """
    task = policy.task
    if (size := task.num_keys * (task.num_choices + 1) * task.num_cells) > _LARGEST:
        raise UserError(f"format: a table of {size:,} entries, expected at most {_LARGEST:,}; format=sets takes less")
    sets = policy.dense()
    # Row t_max + 1 is all sensors on: the file's reader then needs no rule for the forced action.
    return np.concatenate([sets, np.ones_like(sets[:, :1])], axis=1)
