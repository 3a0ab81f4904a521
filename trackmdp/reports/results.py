"""The results of a sweep, small enough to be kept: what a report is made from, and from nothing else.

`runs.csv` holds one row per finished run, `curves.csv` some points of each learning curve, `policies.npz` one policy
per world and method, `worlds.npz` the motion and two reference values, `manifest.json` the rest.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.durable import csv_text, write_bytes, write_text
from trackmdp.reports.checks import check_manifest, checked_figures, checked_settings
from trackmdp.untrusted import decoded, known_object, printable, read_bytes, read_object, read_text, sealed, unsealed
from trackmdp.world.files import load_npz, npz_bytes, whole_csr
from trackmdp.world.model import Array

# Counted up when a file changes its meaning: results of another format are then not taken for stored results.
RESULTS_FORMAT = "trackmdp results 3"
MANIFEST, FILES = "manifest.json", ("runs.csv", "curves.csv", "policies.npz", "worlds.npz")
LARGEST = 2**28
"""Bytes of the longest of these files."""

# A sweep may come from elsewhere, and its folders and options are named by whoever made it.
_FORMULA = ('"', "=", "+", "-", "@", "\t", "\r")
"""A spreadsheet computes a cell that begins so: such names are quoted, as are those that begin with a quote."""

FIGURES: tuple[str, ...]
FIGURES = ("frames", "wall_seconds", "cpu_seconds", "aihtr", "accuracy", "sensors_per_step", "safe_per_episode")
FIGURES += ("expected_length", "qmdp_aihtr", "qmdp_accuracy", "bound_paper", "bound_valid", "bound_clocked")
FIGURES += ("optimal_lower", "optimal_upper")
"""Columns of `runs.csv` that hold what came out of a run; the others are options."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        name: its folder, below that of the sweep.
        settings: every option by its dotted key; an option of a group stands under `<group>.name`.
        figures: `FIGURES`, None where a run has none.
        config_sha256: of its `config.yaml`.
    """

    name: str
    settings: Mapping[str, Any]
    figures: Mapping[str, float | None]
    config_sha256: str

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
        value = self.figures[name]
        return float("nan") if value is None else value


def printable_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run of somebody else's: labels, and so figures and the terminal, have their texts in them."""
    return {printable(key): printable(value) if isinstance(value, str) else value for key, value in settings.items()}


@dataclass(frozen=True)
class CurvePoint:
    """One point of a learning curve."""

    iteration: int
    frames: int
    seconds: float
    aihtr: float


@dataclass(frozen=True)
class Anomaly:
    """Something that is not as planned: a run that is missing, or one that is not like the others."""

    run: str
    text: str

    def __post_init__(self) -> None:
        """Both are shown, and may be those of somebody else: a folder's name need not even be UTF-8."""
        for name in ("run", "text"):
            object.__setattr__(self, name, printable(getattr(self, name)))  # the dataclass is frozen


@dataclass(frozen=True, eq=False)
class Sensed:
    """What a deterministic policy senses, and what that earns.

    Attributes:
        sets: `[M (t_max + 1), M]` bool, row x (t_max + 1) + n the cells sensed at n misses after the target was located
            in x; a share of the detections there, where the policy remembers or is told more than the cell.
        value: `[M]`, expected reward of an episode from each start cell, exactly.
    """

    sets: sparse.csr_array
    value: Array

    @property
    def choices(self) -> int:
        """t_max + 1."""
        return int(self.sets.shape[0] // self.sets.shape[1])

    @property
    def averaged(self) -> bool:
        """Whether `sets` are shares."""
        return bool(self.sets.dtype != np.bool_)

    def on(self, n: int) -> sparse.csr_array:
        """`[M, M]`, the cells sensed at n misses after the target was located in each cell."""
        return self.sets[n :: self.choices]


@dataclass(frozen=True, eq=False)
class MotionTable:
    """A world's motion and two references.

    Attributes:
        kernel: `[M, M]`, sparse.
        qmdp: `[M]`, exact value of Q_MDP per start cell.
        clocked: `[M]`, clocked bound per start cell.
    """

    kernel: sparse.csr_array
    qmdp: Array
    clocked: Array


@dataclass(frozen=True, eq=False)
class Results:
    """All of a sweep.

    Attributes:
        runs: the finished runs, in a fixed order.
        curves: learning curve of each run, by its name.
        policies: of some runs, by their names.
        motions: of the worlds, by the name of the first run in each.
        anomalies: what is missing or mixed.
        manifest: versions, machines, times, the sweep's own line.
    """

    runs: Sequence[FinishedRun]
    curves: Mapping[str, Sequence[CurvePoint]] = field(default_factory=dict)
    policies: Mapping[str, Sensed] = field(default_factory=dict)
    motions: Mapping[str, MotionTable] = field(default_factory=dict)
    anomalies: Sequence[Anomaly] = ()
    manifest: Mapping[str, Any] = field(default_factory=dict)


def is_stored(folder: Path) -> bool:
    """Whether `folder` holds what `save_results` writes, rather than the folders of runs."""
    return bool(known_object(folder / MANIFEST).get("format") == RESULTS_FORMAT)


def save_results(results: Results, folder: Path) -> None:
    """Write `results` to `folder` as `FILES` and the manifest; equal results give equal bytes."""
    # `curves.csv` names a run by its row in `runs.csv`: names are long, and there are many points.
    index = {run.name: number for number, run in enumerate(results.runs)}
    # Most options are the same in all runs: they go to the manifest once, and only the others are columns.
    common = _common(results.runs)
    varied = sorted({key for run in results.runs for key in run.settings if key not in common[run.algo]})
    rows = []
    for run in results.runs:
        name = json.dumps(run.name) if run.name.startswith(_FORMULA) else run.name
        # An empty field says that the run has no such option; an option that is null is written as `null`.
        own = (_cell(run.settings[key]) if key in run.settings else "" for key in varied)
        # `repr` gives the shortest text that is read back as the same float.
        figures = ("" if run.figures[key] is None else repr(run.figures[key]) for key in FIGURES)
        rows.append([name, *own, *figures])
    write_text(folder / "runs.csv", csv_text(["run", *varied, *FIGURES], rows))
    points = [
        # Curves are drawn, not computed with: 7 digits of the AIHTR are more than a figure shows.
        [index[name], point.iteration, point.frames, f"{point.seconds:.4g}", f"{point.aihtr:.7g}"]
        for name, curve in sorted(results.curves.items(), key=lambda item: index[item[0]])
        for point in curve
    ]
    write_text(folder / "curves.csv", csv_text(["run", "iteration", "frames", "seconds", "aihtr"], points))
    write_bytes(folder / "policies.npz", pack_policies(results.policies))
    write_bytes(folder / "worlds.npz", _pack_motions(results.motions))
    manifest = {
        "format": RESULTS_FORMAT,
        **results.manifest,
        "problems": [vars(anomaly) for anomaly in results.anomalies],
        "settings": common,
        "config_sha256": {run.name: run.config_sha256 for run in results.runs},
    }
    # Last, over the files as they are on the disk; `sealed` adds a digest of the manifest itself.
    manifest["files"] = {name: _digest(folder / name) for name in FILES}
    # In ASCII: half a surrogate pair, which a version in somebody's summary may hold, has no form in UTF-8.
    write_text(folder / MANIFEST, json.dumps(sealed(manifest), indent=1) + "\n")


def load_results(folder: Path) -> Results:
    """Read back what `save_results` wrote.

    Raises:
        UserError: a file is missing or damaged.
    """
    source = f"sweep={folder}"
    manifest = unsealed(read_object(folder / MANIFEST, source=source), f"{source}: {MANIFEST}")
    # Everything inside may meet files of somebody else's; whatever is raised there ends as one line about the sweep.
    with decoded(source, "stored results that can be read"):
        files = manifest.pop("files")
        # The files belong together: a `runs.csv` of another report would give figures that its policies do not have.
        for name in FILES:
            if files[name] != _digest(folder / name):
                raise ValueError(f"{name} is not the file that was stored with the others")
        common, hashes = manifest.pop("settings"), manifest.pop("config_sha256")
        anomalies = [Anomaly(**entry) for entry in manifest.pop("problems")]
        del manifest["format"]
        check_manifest(manifest)
        runs = [_run(row, common, hashes) for row in _rows(folder / "runs.csv")]
        curves: dict[str, list[CurvePoint]] = {}
        for row in _rows(folder / "curves.csv"):
            point = CurvePoint(int(row["iteration"]), int(row["frames"]), float(row["seconds"]), float(row["aihtr"]))
            curves.setdefault(runs[int(row["run"])].name, []).append(point)
        policies = unpack_policies(read_bytes(folder / "policies.npz", most=LARGEST))
        motions = _unpack_motions(read_bytes(folder / "worlds.npz", most=LARGEST))
    return Results(runs, curves, policies, motions, anomalies, manifest)


def _digest(file: Path) -> str:
    return hashlib.sha256(read_bytes(file, most=LARGEST)).hexdigest()


def _run(row: Mapping[str, str], common: Mapping[str, Any], hashes: Mapping[str, str]) -> FinishedRun:
    own = {key: _value(text) for key, text in row.items() if key not in FIGURES and key != "run" and text != ""}
    figures = checked_figures({key: float(row[key]) if row[key] else None for key in FIGURES})
    # A single algorithm needs no column for its name: then it is the one key of `common`.
    algo = own.get("algo.name") or next(iter(common))
    # The other half of what `save_results` does to a name that looks like a formula.
    name = str(_value(row["run"])) if row["run"].startswith('"') else row["run"]
    settings = checked_settings(printable_settings({**common[algo], **own, "algo.name": algo}))
    return FinishedRun(name, settings, figures, hashes[name])


def _common(runs: Iterable[FinishedRun]) -> dict[str, dict[str, Any]]:
    """Algorithm -> the options that have one value in all of its runs."""
    found: dict[str, dict[str, Any]] = {}
    for run in runs:
        shared = found.get(run.algo, run.settings)
        found[run.algo] = {k: v for k, v in shared.items() if k in run.settings and run.settings[k] == v}
    # With several algorithms each row has to name its own, by which the rest of its options is found.
    several = len(found) > 1
    return {algo: {k: v for k, v in found[algo].items() if k != "algo.name" or not several} for algo in sorted(found)}


def _cell(value: Any) -> str:
    """Text of a setting, from which `_value` tells a number from a word."""
    if isinstance(value, str):
        # "3", "true" and "" as words need quotes, or `_value` would read a number, a truth value, or no option at all.
        return json.dumps(value) if _value(value) != value or value == "" or value.startswith(_FORMULA) else value
    return json.dumps(value)


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


def pack_policies(policies: Mapping[str, Sensed]) -> bytes:
    """The bytes of a file with many policies, each under a name; sorted, so that the same ones give the same bytes."""
    names = sorted(policies)
    sets = [policies[name].sets for name in names]
    # All in one row of arrays, one after the other: a file with four arrays for each would be mostly headers. A CSR
    # matrix of m rows has m + 1 row pointers, which begin anew at 0 for each. Every entry stored is a sensor on, or
    # with `shares` that share.
    packed = {
        "names": np.array(names, dtype=np.str_),
        # `reshape`: no policy at all is still a table of three columns.
        "shapes": np.array([(*each.shape, each.nnz) for each in sets], dtype=np.int64).reshape(-1, 3),
        "indices": _joined((each.indices for each in sets), np.int32),
        "indptr": _joined((each.indptr for each in sets), np.int64),
        "values": _joined(policies[name].value for name in names),
    }
    averaged = np.array([policies[name].averaged for name in names])
    if averaged.any():
        packed |= {"shares": _joined((each.data for each in sets), np.float32), "averaged": averaged}
    return npz_bytes(packed)


def unpack_policies(content: bytes) -> dict[str, Sensed]:
    """What `pack_policies` packed.

    Raises:
        Exception: the bytes are something else; call it inside `untrusted.decoded`.
    """
    stored = load_npz(io.BytesIO(content))
    names, shapes = stored["names"], stored["shapes"]
    stored = {"shares": np.ones(len(stored["indices"])), "averaged": np.zeros(len(names))} | stored
    entries = shapes[:, 2]
    parts = _apart(stored, indices=entries, shares=entries, indptr=shapes[:, 0] + 1, values=shapes[:, 1])
    rows = zip(names, shapes.tolist(), stored["averaged"], parts, strict=False)
    return {
        str(name): Sensed(whole_csr(share.astype(float if mean else bool), cells, pointer, tuple(shape[:2])), value)
        for name, shape, mean, (cells, share, pointer, value) in rows
    }


def _pack_motions(motions: Mapping[str, MotionTable]) -> bytes:
    names = sorted(motions)
    each = [motions[name] for name in names]
    packed = {
        "runs": np.array(names, dtype=np.str_),
        "cells": np.array([len(m.qmdp) for m in each], dtype=np.int64),
        "entries": np.array([m.kernel.nnz for m in each], dtype=np.int64),
        "data": _joined(m.kernel.data for m in each),
        "indices": _joined((m.kernel.indices for m in each), np.int32),
        "indptr": _joined((m.kernel.indptr for m in each), np.int32),
        "qmdp": _joined(m.qmdp for m in each),
        "clocked": _joined(m.clocked for m in each),
    }
    return npz_bytes(packed)


def _unpack_motions(content: bytes) -> dict[str, MotionTable]:
    stored = load_npz(io.BytesIO(content))
    cells, entries = stored["cells"], stored["entries"]
    parts = _apart(stored, data=entries, indices=entries, indptr=cells + 1, qmdp=cells, clocked=cells)
    return {
        str(name): MotionTable(whole_csr(data, indices, indptr, (m, m)), qmdp, clocked)
        for name, m, (data, indices, indptr, qmdp, clocked) in zip(stored["runs"], cells.tolist(), parts, strict=False)
    }


def _joined(parts: Iterable[np.ndarray], kind: Any = np.float64) -> np.ndarray:
    """Arrays `[K_i]` end to end, the form in which many small ones are stored; `[0]` of none."""
    return np.concatenate([np.zeros(0), *parts]).astype(kind)


def _apart(stored: Mapping[str, np.ndarray], **sizes: np.ndarray) -> Iterator[tuple[Any, ...]]:
    """Of each item its part of every stream of `_joined`, in which item i takes `sizes[i]` places."""
    for name, size in sizes.items():
        if size.dtype.kind not in "iu" or not ((size >= 0) & (size < LARGEST)).all():
            raise ValueError("counts that are none")
        if stored[name].shape != (size.sum(),) or stored[name].dtype.kind not in "iuf":
            raise ValueError(f"{name}: expected {size.sum()} numbers")
    # The last sum is the end of the stream, not a place to cut.
    return zip(*(np.split(stored[name], np.cumsum(size)[:-1]) for name, size in sizes.items()), strict=True)


def _rows(file: Path) -> list[dict[str, str]]:
    text = read_text(file, most=LARGEST)
    return list(csv.DictReader(io.StringIO(text, newline=""), strict=True))
