"""Read a finished run from its folder: options, figures and learning curve, or the reason why that is not possible."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.config.tree import flatten, plain_mapping
from trackmdp.config.untrusted import MAX_BYTES
from trackmdp.errors import UserError
from trackmdp.policies.saved import load_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.reports.checks import LARGEST_FIGURE, check_origin, checked_figures, checked_settings
from trackmdp.reports.results import FIGURES, Anomaly, CurvePoint, FinishedRun, Sensed, printable_settings
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.training.folders import FAILED_FILE, SUMMARY, check_files, read_summary, run_of
from trackmdp.untrusted import decoded, known_object, printable, read_text
from trackmdp.world.model import Array

MOST_POINTS = 16
"""Points kept of a learning curve: evenly spaced in the logarithm of the iteration."""

_TABLE = 2**28
"""Bytes of the longest `metrics.csv`: two million rows."""


def read_run(folder: Path, name: str) -> tuple[FinishedRun, Mapping[str, Any]] | Anomaly:
    """A run and its summary, or why there is none."""
    place = folder / name
    if name.encode(errors="replace").decode() != name:  # in the tables it has to be text
        return Anomaly(name, "its folder's name is not UTF-8")
    if (place / FAILED_FILE).is_file():
        reason = known_object(place / FAILED_FILE).get("reason", "no reason given")
        return Anomaly(name, f"failed: {printable(str(reason))}")
    if not place.is_dir() or not (place / "config.yaml").is_file():
        return Anomaly(name, "not started")
    # The summary is written last: without it a run is under way or was killed, and its figures are not final.
    if not (place / SUMMARY).is_file():
        running = run_of(place).state == "running"
        return Anomaly(name, "still running" if running else f"cut: it has no {SUMMARY}")
    try:
        summary = read_summary(place)
        check_files(place, summary, "config.yaml")
        settings = printable_settings(flatten(plain_config(place)))
        # A config of another version may lack what runs are grouped by: that is told of this run, and the others are
        # used.
        with decoded(str(place / "config.yaml"), "the config of a run"):
            checked_settings(settings)
        with decoded(str(place / SUMMARY), "the summary of a run"):
            if not isinstance(summary["config_sha256"], str):
                raise TypeError("config_sha256: expected a digest")
            for key in ("versions", "machine"):
                check_origin(key, summary.get(key, {}))
            return FinishedRun(name, settings, _figures(summary), summary["config_sha256"]), summary
    except UserError as error:
        return Anomaly(name, str(error).replace(f"{place}/", ""))


def plain_config(place: Path) -> Mapping[str, Any]:
    """The plain config of a run, which another version may have written.

    Raises:
        UserError: it cannot be read.
    """
    file = place / "config.yaml"
    return plain_mapping(read_text(file, most=MAX_BYTES), str(file))


def _figures(summary: Mapping[str, Any]) -> dict[str, float | None]:
    """`FIGURES` of a summary; on recorded tracks there is no Q_MDP, no bound and no optimum."""
    groups = {"qmdp": summary["qmdp"], "bound": summary["bounds"], "optimal": summary["optimal"]}
    raw = {key: summary[key] for key in ("frames", "wall_seconds", "cpu_seconds")} | summary["policy"]
    raw |= {f"{group}_{key}": value for group, values in groups.items() for key, value in (values or {}).items()}
    return checked_figures({key: raw.get(key) for key in FIGURES})


def read_curve(file: Path) -> list[CurvePoint]:
    """The points of a run's `metrics.csv` at which the policy was evaluated, thinned; none where it cannot be read."""
    try:
        text = read_text(file, most=_TABLE)
        with decoded(str(file), "a learning curve"):
            points = _points(text)
    except UserError:
        return []
    if len(points) <= MOST_POINTS:
        return points
    # More points early, where a curve moves; the last one always, since it is what the run came to.
    wanted = np.geomspace(1, len(points), MOST_POINTS).round().astype(int) - 1
    return [points[place] for place in sorted({*wanted.tolist(), len(points) - 1})]


def _points(text: str) -> list[CurvePoint]:
    """The points, in the order of iterations as they were written."""
    points: list[CurvePoint] = []
    for row in csv.DictReader(io.StringIO(text, newline="")):
        # Most iterations are not evaluated, and have an empty field.
        if not row.get("aihtr"):
            continue
        last = points[-1] if points else CurvePoint(0, 0, 0.0, 0.0)
        point = CurvePoint(int(row["iteration"]), int(row["frames"]), float(row["seconds"]), float(row["aihtr"]))
        if not (
            last.iteration < point.iteration < LARGEST_FIGURE and max(last.frames, 1) <= point.frames < LARGEST_FIGURE
        ):
            raise ValueError("iterations or frames that do not grow")
        if not (
            0 <= point.seconds < LARGEST_FIGURE and math.isfinite(point.aihtr) and abs(point.aihtr) < LARGEST_FIGURE
        ):
            raise ValueError("a number out of range")
        points.append(point)
    return points


def read_sensed(file: Path, size: tuple[int, int], t_max: Any, visits: Callable[[PolicyTable], Array]) -> Sensed:
    """Read a policy back.

    Args:
        file: of a run.
        size: rows and columns of the run's grid.
        t_max: of the run, as its config has it.
        visits: `[keys]` of a policy that remembers or is told more than the cell, how often it comes to each key: its
            plans for one cell are averaged with these weights.

    Raises:
        UserError: the file is missing or damaged, or holds something else, as the policy of another grid or t_max.
    """
    table, value = load_policy(file)
    # First of all: a table of one size and visits of another would be taken together below, at any length.
    if (table.task.size, table.task.t_max) != (size, t_max):
        raise UserError(f"{file}: not the policy of this run (of another grid or t_max)")
    if value is None:
        raise UserError(f"{file}: not the policy of a run (it has no values)")
    if not (np.abs(value) < LARGEST_FIGURE).all():
        raise UserError(f"{file}: not the policy of a run (a value out of range)")
    if not table.deterministic:
        raise UserError("policy: draws its sets at random, so that there is no table of them")
    task = table.task
    # One probability for all sensors is written out: all of them on, on a grid small enough, or none.
    shape = (task.num_keys * task.num_choices, task.total_sensors)
    sets = table.sets
    if sets is None:
        sets = sparse.csr_array(table.dense().reshape(shape) if table.probability else shape, dtype=bool)
    sets = sets if task.coverage is None else task.coverage.seen(sets)
    return Sensed(_averaged(table, sets, visits(table)) if task.keyed else sets, value)


def _averaged(policy: PolicyTable, sets: sparse.csr_array, visits: Array) -> sparse.csr_array:
    """`[M (t_max + 1), M]`, means of `sets` `[keys (t_max + 1), M]` over the keys of each cell."""
    task = policy.task
    keys: IndexArray = np.arange(task.num_keys)
    cells = task.keys.cell(keys)
    # no cell without visits: episodes start anywhere
    share = visits / per_row(cells, visits, task.num_cells)[cells]
    means = sparse.csr_array((share, (cells, keys)), shape=(task.num_cells, task.num_keys))
    # Row x (t_max + 1) + n of the result is that of the keys at the same n.
    found = sparse.kron(means, sparse.eye_array(task.num_choices), format="csr") @ sets.astype(np.float64)
    found.sort_indices()
    return sparse.csr_array(found)
