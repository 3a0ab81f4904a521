"""A policy in an ONNX file, for a `Tracker`: its sets by onnxruntime, its task from the metadata; without torch."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from trackmdp.arrays.entries import ones_at
from trackmdp.arrays.types import BoolArray
from trackmdp.errors import require
from trackmdp.grid.place import Place
from trackmdp.sensing.task import Task
from trackmdp.untrusted import LARGE, decoded, read_bytes


class OnnxTable:
    """The sets in a `policy.onnx` (`trackmdp.policies.export`).

    Args:
        file: the model.

    Attributes:
        task: size, limits, sensors, memory, footprints and place; prices are not in the file and stand as 0.

    Raises:
        UserError: onnxruntime is not installed, or the file is missing, damaged or no exported policy.
    """

    def __init__(self, file: str | Path) -> None:
        require("onnxruntime", "onnx", f"{file}")
        import onnxruntime

        content = read_bytes(Path(file), most=LARGE, links=True)
        with decoded(str(file), "an exported policy"):
            self._session = onnxruntime.InferenceSession(
                content, providers=["CPUExecutionProvider"]
            )
            about = self._session.get_modelmeta().custom_metadata_map
            sensors = self._session.get_outputs()[0].shape[1]
            self.task = _task(about, int(sensors))
            # The last row of all: a table of another shape than the metadata is no exported policy.
            on = self._looked_up(self.task.num_keys - 1, self.task.t_max)
            if on.shape != (self.task.total_sensors,):
                raise ValueError(f"{on.shape} sensors, expected {self.task.total_sensors}")

    def sensors(self, key: int, misses: int) -> list[int]:
        """The sensors on, n misses after the detection that left `key`."""
        return np.flatnonzero(self._looked_up(key, misses)).tolist()

    def _looked_up(self, key: int, misses: int) -> BoolArray:
        """`[S]`, the action of the model."""
        names = (each.name for each in self._session.get_inputs())
        state = {name: np.array([it]) for name, it in zip(names, (key, misses), strict=True)}
        (action,) = self._session.run(["action"], state)
        return np.asarray(action[0], np.bool_)


def _task(about: dict[str, str], sensors: int) -> Task:
    """The task of the metadata."""
    size = int(about["rows"]), int(about["columns"])
    more: dict[str, object] = {}
    if "memory" in about:
        more = {"memory": about["memory"], "clip": int(about["clip"])}
        more["revealed"] = int(about["modes"])
    if "footprints" in about:
        cells = json.loads(about["footprints"])
        rows = np.repeat(np.arange(len(cells)), [len(each) for each in cells])
        columns = np.concatenate(cells).astype(np.int64)
        more["coverage"] = ones_at(rows, columns, (sensors, size[0] * size[1]))
    if "place" in about:
        more["place"] = Place(**json.loads(about["place"]))
    cost = np.zeros(sensors)
    cost[json.loads(about.get("absent", "[]"))] = np.nan
    return Task(size, cost=cost, t_max=int(about["t_max"]), **more)  # type: ignore[arg-type]
