"""Results of a sweep in one file, `results.npz`, from which alone a report is made."""

from __future__ import annotations

import dataclasses
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.arrays.files import npz_bytes
from trackmdp.arrays.types import Array
from trackmdp.durable import write_bytes
from trackmdp.untrusted import decoded, load_npz, printable, read_bytes
from trackmdp.world.problem_file import as_arrays, from_arrays

RESULTS = "results.npz"
# Raised by 1 when the meaning of the content changes: a file of another format is refused.
FORMAT = "trackmdp results 5"
_LARGEST, _LONGEST_TEXT = 2**30, 2**26
"""Bytes of the longest file that is read, and of its text when unpacked: twenty thousand runs."""

NEEDED = ("frames", "wall_seconds", "cpu_seconds", "aihtr", "expected_length")
"""Figures of every run."""
FIGURES = (*NEEDED, "accuracy", "sensors_per_step", "optimal_lower", "optimal_upper")
HELD_OUT = ("held_out_aihtr", "held_out_accuracy", "held_out_sensors_per_step")
"""Figures of a run on recordings; its other figures are those on the validation tracks."""

CONTENT = "kernel.content"
"""Setting of a run whose world is read from files: a digest of their content."""

Figures = Mapping[str, float | None]


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        name: folder, below the folder of the sweep.
        settings: all options by dotted key; the choice of a group under `<group>.name`.
        figures: `FIGURES`, and `HELD_OUT` on recordings; None where a run has no such figure.
        references: name of another policy, or of a bound -> its figures in the same world.
        curve: points (frames, seconds, AIHTR) of the learning curve.
    """

    name: str
    settings: Mapping[str, Any]
    figures: Figures
    references: Mapping[str, Figures] = field(default_factory=dict)
    curve: Sequence[Sequence[float]] = ()

    @property
    def algo(self) -> str:
        """Name of the algorithm."""
        return str(self.settings["algo.name"])

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return int(self.settings["seed"])

    def figure(self, name: str) -> float:
        """A figure, nan where the run has none."""
        value = self.figures.get(name)
        return math.nan if value is None else value


def checked(run: FinishedRun) -> FinishedRun:
    """A run of plain values of a file.

    Raises:
        Exception: of any kind, for values of another kind; call it inside `untrusted.decoded`.
    """
    plain = {
        printable(key): printable(value) if isinstance(value, str) else value
        for key, value in run.settings.items()
    }
    named: dict[str, Any] = {key: str(plain[key]) for key in ("algo.name", "kernel.name")}
    named |= {"seed": int(plain["seed"]), "grid.size": plain["grid.size"]}
    numbers = _numbers(run.figures)
    missing = [key for key in NEEDED if numbers[key] is None]
    if missing or not numbers["expected_length"]:  # regrets are per step
        raise ValueError(f"{missing or 'expected_length'}: expected a number above 0")
    others = {str(key): _numbers(each) for key, each in run.references.items()}
    points = [tuple(map(float, point)) for point in run.curve]
    # As they are stored: YAML has dates and sets as well, and whole numbers of any length.
    settings = json.loads(json.dumps(plain | named))
    return FinishedRun(run.name, settings, numbers, others, points)


def _numbers(figures: Mapping[str, Any]) -> dict[str, float | None]:
    return {key: None if value is None else float(value) for key, value in figures.items()}


@dataclass(frozen=True)
class Anomaly:
    """A run that is missing or differs from the others, and the reason."""

    run: str
    text: str


@dataclass(frozen=True, eq=False)
class Mapped:
    """A policy of the sweep, cell by cell, beside the best and the simplest policy known.

    Attributes:
        world: label of the world.
        method: label of the method.
        seed: of the run, as text: it may be larger than the integers of an array.
        size: rows and columns of the grid, M = rows x columns.
        averaged: whether the policy remembers more than the cell: `sets` are then shares of the detections in a cell.
        sets: `[M (t_max + 1), M]`, row x (t_max + 1) + n: 1 for cells sensed at n misses after a detection in x.
        value: `[M]`, exact expected reward of an episode from each start cell.
        kernel: `[M, M]`, the motion; without entries on large grids.
        after: `[M, M]`, row x: where the target is after a detection in x, a miss and one more move; as `kernel`.
        bound: `[M]`, clocked bound on `value`.
        qmdp: `[M]`, exact value of Q_MDP; nan where unknown.
    """

    world: str
    method: str
    seed: str
    size: tuple[int, int]
    averaged: bool
    sets: sparse.csr_array
    value: Array
    kernel: sparse.csr_array
    after: sparse.csr_array
    bound: Array
    qmdp: Array

    @property
    def choices(self) -> int:
        """t_max + 1."""
        return int(self.sets.shape[0] // self.sets.shape[1])

    @property
    def label(self) -> str:
        """The run, for captions."""
        return f"{self.method}, {self.world}, seed {self.seed} (n = 1)"

    def on(self, n: int) -> sparse.csr_array:
        """`[M, M]`, cells sensed at n misses after a detection in each cell."""
        return self.sets[n :: self.choices]


@dataclass(frozen=True, eq=False)
class Results:
    """All results of a sweep.

    Attributes:
        runs: finished runs, in a fixed order.
        maps: policies that are drawn.
        anomalies: runs that are missing or differ.
        manifest: `line`, `last`, whether there were other lines before it, `planned`, the number of runs of all lines,
            `wall_seconds`, `cpu_seconds`, `versions`, `machines`.
    """

    runs: Sequence[FinishedRun]
    maps: Sequence[Mapped] = ()
    anomalies: Sequence[Anomaly] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)


def is_stored(folder: Path) -> bool:
    """Whether `folder` holds stored results rather than the folders of runs."""
    return (folder / RESULTS).is_file()


def save_results(results: Results, folder: Path) -> None:
    """Write `results.npz` to `folder`; equal results give equal bytes."""
    content = {
        "format": FORMAT,
        "manifest": dict(results.manifest),
        "runs": [vars(run) for run in results.runs],
        "maps": len(results.maps),
        "anomalies": [vars(anomaly) for anomaly in results.anomalies],
    }
    arrays: dict[str, Any] = {"text": np.frombuffer(json.dumps(content).encode(), np.uint8)}
    for place, each in enumerate(results.maps):
        arrays |= as_arrays({f"{name}{place}": value for name, value in vars(each).items()})
    write_bytes(folder / RESULTS, npz_bytes(arrays))


def load_results(folder: Path) -> Results:
    """The results that `save_results` wrote to `folder`.

    Raises:
        UserError: the file is damaged or of another format.
    """
    file = folder / RESULTS
    with decoded(f"sweep={folder}", f"stored results that can be read ({RESULTS})"):
        arrays = load_npz(io.BytesIO(read_bytes(file, most=_LARGEST)))
        text = arrays.pop("text").tobytes()
        if len(text) > _LONGEST_TEXT:  # lists of nothing take twenty times the memory of their text
            raise ValueError(f"{len(text):,} bytes of text, expected at most {_LONGEST_TEXT:,}")
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}, expected {FORMAT!r}")
        given = from_arrays(arrays)
        runs = [checked(FinishedRun(**run)) for run in content["runs"]]
        maps = [_mapped(place, given) for place in range(content["maps"])]
        anomalies = [Anomaly(**each) for each in content["anomalies"]]
        return Results(runs, maps, anomalies, _manifest(content["manifest"]))


def _manifest(given: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest, of values of the kinds that `Results` names."""
    times = {f"{kind}_seconds": float(given.get(f"{kind}_seconds", 0)) for kind in ("wall", "cpu")}
    counted = {
        key: [{**each, "runs": int(each["runs"])} for each in given.get(key, ())]
        for key in ("versions", "machines")
    }
    return {**given, **times, **counted, "line": str(given.get("line") or "")}


def _mapped(place: int, given: Mapping[str, Any]) -> Mapped:
    parts = {each.name: given[f"{each.name}{place}"] for each in dataclasses.fields(Mapped)}
    rows, columns = parts["size"].tolist()
    found = Mapped(**parts | {"size": (rows, columns)})
    lengths = {len(each) for each in (found.value, found.bound, found.qmdp)}
    shapes = {*found.kernel.shape, *found.after.shape, found.sets.shape[1]}
    if lengths | shapes != {rows * columns}:
        raise ValueError(f"map {place}: arrays of other lengths than its {rows * columns} cells")
    return found
