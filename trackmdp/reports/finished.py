"""One finished run in its folder: options, figures, learning curve, and its policy cell by cell."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.arrays.entries import per_row, summing
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.config.tree import flatten
from trackmdp.errors import UserError
from trackmdp.policies.saved import load_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.reports.maps import MOST_MAP_CELLS
from trackmdp.reports.results import CONTENT, FIGURES, HELD_OUT, FinishedRun, Mapped, checked
from trackmdp.solvers import bounds, rules
from trackmdp.solvers.hidden import averaged, mode_shares
from trackmdp.solvers.linear import DIRECT_CELLS
from trackmdp.solvers.value import key_visits, value_of
from trackmdp.training.folders import METRICS, SUMMARY, check_files, read_summary
from trackmdp.untrusted import LARGE, decoded, parse_yaml, read_text
from trackmdp.world.model import World
from trackmdp.world.problem_file import PROBLEM, digest_of, read_problem

MOST_POINTS = 16
"""Points kept of a learning curve, evenly spaced in the logarithm of the iteration."""

_TRACKED = {name: name.removeprefix("held_out_") for name in HELD_OUT}
_OF_FILES = {
    "kernel.path": ("kernel", "tracks", "validation", "held_out"),
    "cost.sensor": ("cost",),
    "sensor.path": ("coverage",),
    "sensor.p_d": ("detection",),
    "sensor.p_s": ("safe_detection",),
}
"""Options that may name a file -> the arguments read from it, in `problem.npz`."""
_BOUNDS = {"printed bound": "paper", "valid bound": "valid", "clocked bound": "clocked"}


def read_run(place: Path, name: str) -> tuple[FinishedRun, Mapping[str, Any]]:
    """The run in the folder `place`, and its summary.

    Raises:
        UserError: a file is missing, damaged, or of another run.
    """
    summary = read_summary(place)
    check_files(place, summary, "config.yaml")
    config = parse_yaml(read_text(place / "config.yaml"), str(place / "config.yaml"))
    curve = read_curve(place, summary) if (place / METRICS).is_file() else []
    with decoded(str(place / SUMMARY), "the summary of a run"):
        settings, figures = flatten(config), _figures(summary)
        read = [
            each
            for key in _OF_FILES
            if isinstance(settings.get(key), str)
            for each in _OF_FILES[key]
        ]
        if read:  # a file may have changed between two runs that name it
            check_files(place, summary, PROBLEM)
            settings[CONTENT] = digest_of(place / PROBLEM, read)[:8]
        run = FinishedRun(name, settings, figures, _references(summary), curve)
        return checked(run), summary


def _figures(summary: Mapping[str, Any]) -> dict[str, Any]:
    """`FIGURES` of a summary, of all targets together, and `HELD_OUT` where there are validation tracks."""
    if several := summary.get("several"):
        # Known to be attained: proved, or simulated of the merged optimum.
        merged = _together(several["merged_optimum"]).get("aihtr")
        known = [value for value in (several["lower"], merged) if value is not None]
        ends = {"optimal_lower": max(known, default=None), "optimal_upper": several["upper"]}
        found = {**summary, **_together(several["figures"]), **several, **ends}
        return {name: found.get(name) for name in FIGURES}
    validation, policy = summary.get("validation"), summary["policy"]
    solved = {f"optimal_{key}": value for key, value in (summary["optimal"] or {}).items()}
    # On recordings figures are compared, and options chosen, by the validation tracks alone.
    found = {**summary, **(validation or policy), **solved}
    held_out = {name: policy.get(own) for name, own in _TRACKED.items()} if validation else {}
    return {name: found.get(name) for name in FIGURES} | held_out


def _references(summary: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Figures of other policies and bounds in the same world; on recordings those on the held-out tracks."""
    if several := summary.get("several"):
        # Q_MDP and fixed sets are of a single target.
        policies = {"best known": _together(several["merged_optimum"])}
        alone = {"separate trackers": several["apart"], "clocked bound": several["upper"]}
    elif held_out := summary.get("held_out"):
        return {
            name: {key: figures[own]["mean"] for key, own in _TRACKED.items()}
            for name, figures in held_out["figures"].items()
            if name != "policy"
        }
    else:
        policies = {"Q_MDP": summary["qmdp"], **summary.get("references", {})}
        alone = {name: summary["bounds"].get(key) for name, key in _BOUNDS.items()}
    found = {
        name: {key: each.get(key) for key in _TRACKED.values()}
        for name, each in policies.items()
        if each
    }
    return found | {name: {"aihtr": value} for name, value in alone.items() if value is not None}


def _together(figures: Mapping[str, Mapping[str, Any]] | None) -> dict[str, Any]:
    """Means of figures of several targets; none of None."""
    known = figures or {}
    return {name: known[name]["mean"] for name in _TRACKED.values() if name in known}


def read_curve(place: Path, summary: Mapping[str, Any]) -> Sequence[Sequence[float]]:
    """Points (frames, seconds, AIHTR) of the evaluations in `metrics.csv`, thinned to `MOST_POINTS`.

    None of a single target's plan that is merged: its curve is not of all targets.

    Raises:
        UserError: the file is damaged or of another run.
    """
    file, several = place / METRICS, summary.get("several")
    check_files(place, summary, METRICS)
    with decoded(str(file), "a learning curve"):
        if several and several["merge"] != "joint":
            return []
        rows = csv.DictReader(io.StringIO(read_text(file, most=LARGE), newline=""))
        columns = ("frames", "seconds", "aihtr")
        # An iteration without an evaluation has an empty field.
        points = [tuple(float(row[key]) for key in columns) for row in rows if row["aihtr"]]
    if len(points) <= MOST_POINTS:
        return points
    wanted = np.geomspace(1, len(points), MOST_POINTS).round().astype(int) - 1
    return [points[place] for place in np.unique(wanted)]


def read_map(place: Path, run: FinishedRun, world: str, method: str) -> Mapped | None:
    """The policy of the run in the folder `place`, cell by cell.

    None on recordings, which have no motion, and of several targets, whose sets depend on all their cells.

    Raises:
        UserError: a file is missing, damaged, or of another run.
    """
    summary = read_summary(place)
    check_files(place, summary, "policy.npz", PROBLEM)
    if summary.get("several"):
        return None
    problem = read_problem(place / PROBLEM).model
    if problem is None:
        return None
    table, value = load_policy(place / "policy.npz")
    if table.task.size != problem.size or table.task.t_max != problem.t_max or value is None:
        raise UserError(f"{place / 'policy.npz'}: not the policy of this run")
    if not table.deterministic:
        raise UserError(f"{place / 'policy.npz'}: sets drawn at random, so that there is no map")
    # `[keys (t_max + 1), M]`: cells in view of the sensors on, and the probability of a report there.
    written = PolicyTable(table.task, table.written)
    sets, reports = written.seen, written.reporting
    if table.task.keyed:
        visits = key_visits(problem, table)
        sets, reports = (averaged_sets(table, each, visits) for each in (sets, reports))
    kernel, bound, simple = _references_by_cell(problem)
    return Mapped(
        *(world, method, str(run.seed), table.task.size),
        averaged=table.task.keyed,
        sets=sets.astype(np.float64),
        value=value,
        kernel=kernel,
        after=after_a_miss(problem, reports[:: problem.num_choices]),
        bound=bound,
        qmdp=simple,
    )


def averaged_sets(table: PolicyTable, sets: sparse.csr_array, visits: Array) -> sparse.csr_array:
    """`[M (t_max + 1), M]`, means of `sets` `[keys (t_max + 1), M]` over the keys of each cell.

    Args:
        table: the policy.
        sets: cells in view of the sensors on, with each key and n.
        visits: `[keys]`, weights: expected visits of each key.
    """
    task = table.task
    keys: IndexArray = np.arange(task.num_keys)
    cells = task.keys.cell(keys)
    # Episodes start in every cell: no sum of visits is 0.
    share = visits / per_row(cells, visits, task.num_cells)[cells]
    means = sparse.csr_array((share, (cells, keys)), shape=(task.num_cells, task.num_keys))
    # Row x (t_max + 1) + n of the result: the mean of rows key (t_max + 1) + n over the keys of x.
    found = sparse.kron(means, sparse.eye_array(task.num_choices), format="csr") @ sets.astype(
        np.float64
    )
    return sparse.csr_array(found).sorted_indices()


def after_a_miss(problem: World, first: sparse.csr_array) -> sparse.csr_array:
    """`Mapped.after`, with the probability of a report in each cell `first` `[M, M]` at once after a detection.

    Along the hidden states: the next move may depend on the last one.
    """
    m = problem.num_cells
    if m > MOST_MAP_CELLS:
        return sparse.csr_array((m, m))
    of_cell = summing(problem.motion.cell, m)
    mass = of_cell @ sparse.diags_array(mode_shares(problem)) @ problem.kernel
    missed = mass - mass.multiply(first @ of_cell)
    return sparse.csr_array(missed @ problem.kernel @ of_cell.T).sorted_indices()


def _references_by_cell(problem: World) -> tuple[sparse.csr_array, Array, Array]:
    """Motion `[M, M]`, clocked bound `[M]` and value of Q_MDP `[M]`."""
    world, bound = averaged(problem), bounds.clocked(problem)
    m = world.num_cells
    kernel = world.kernel if m <= MOST_MAP_CELLS else sparse.csr_array(world.kernel.shape)
    # Q_MDP on a large grid takes minutes and gigabytes where it senses little.
    simple = value_of(problem, rules.qmdp(world)).value if m <= DIRECT_CELLS else np.full(m, np.nan)
    return kernel, bound, simple
