"""From the folder of a sweep to its results; what cannot be read is named, and the rest is used."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from scipy import sparse

from trackmdp.config import TableConfig, WorldConfig, world_of
from trackmdp.config.registry import make
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.reports.finished import plain_config, read_curve, read_run, read_sensed
from trackmdp.reports.grouping import Study, study, world_key
from trackmdp.reports.maps import MOST_MAP_CELLS
from trackmdp.reports.results import Anomaly, FinishedRun, MotionTable, Results, Sensed
from trackmdp.solvers import bounds, qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.keyed import averaged, visits_of_keys
from trackmdp.solvers.keyed_search import cell_bound
from trackmdp.solvers.renewal import DIRECT_CELLS
from trackmdp.training.folders import FAILED_FILE, PLAN, PLAN_BYTES, SUMMARY, check_files, read_summary
from trackmdp.untrusted import known_object, printable
from trackmdp.world.checks import canonical_kernel
from trackmdp.world.make import build_world, of_task
from trackmdp.world.model import Array, grid_size
from trackmdp.world.modes import HiddenWorld, Modelled

_LONGEST, _LONGEST_NAME = 4096, 255
"""Bytes of the longest path of a plan that is looked at, and of a name in it: asked for longer ones, systems raise."""


def gather_runs(folder: Path) -> Results:
    """Read every run below `folder`.

    Args:
        folder: of a sweep, perhaps one that is not done.

    Raises:
        UserError: there is no run at all.
    """
    plan = planned(folder)
    names = run_folders(folder, plan)
    if not names:
        raise UserError(f"sweep={folder}: no runs in there, expected the folder of a sweep or of stored results")
    anomalies: list[Anomaly] = []
    runs, summaries = [], []
    for name in names:
        # One damaged run does not cost the report of the others: it is listed under what is missing.
        read = read_run(folder, name)
        if isinstance(read, Anomaly):
            anomalies.append(read)
        else:
            runs.append(read[0])
            summaries.append(read[1])
    anomalies += [*_repeated(runs), *_mixed(runs, summaries)]
    # A folder that was copied would count one seed twice, and narrow the interval.
    repeated = {anomaly.run for anomaly in _repeated(runs)}
    runs = [run for run in runs if run.name not in repeated]
    curves = {run.name: read_curve(folder / run.name / "metrics.csv") for run in runs}
    grouped = study(runs)
    whole = [run.name for run in runs if run.settings.get("partition.block") is None]  # each block has a curve
    anomalies += [Anomaly(name, "no learning curve") for name in whole if not curves[name]]
    # Nothing says otherwise what was planned: the seeds of one world are what the others are expected to have.
    anomalies += _missing_seeds(grouped) if plan is None else []  # a plan says what else there should be
    policies, unread = _policies(folder, grouped)
    motions, unbuilt = _motions(folder, runs)
    manifest = _manifest(plan, summaries)
    return Results(
        runs, {n: c for n, c in curves.items() if c}, policies, motions, anomalies + unread + unbuilt, manifest
    )


def planned(folder: Path) -> Mapping[str, Any] | None:
    """The content of `sweep.json`, where there is a readable one."""
    plan = known_object(folder / PLAN, most=PLAN_BYTES)
    return plan if isinstance(plan.get("jobs"), list) else None


def run_folders(folder: Path, plan: Mapping[str, Any] | None) -> list[str]:
    """The runs' folders, relative to the sweep's, in a fixed order: those that were planned, and those found.

    A plan that names a folder outside of the sweep's, directly or through a link, is not followed there.
    """
    jobs = plan["jobs"] if plan else []
    # The plan may have been written by somebody else, so that every entry is looked at before it is used.
    listed = [job["folder"] for job in jobs if isinstance(job, dict) and isinstance(job.get("folder"), str)]
    root = os.path.realpath(folder)
    named = {_relative((root, folder), name) for name in listed if _is_path(name)}
    # Any of these makes a folder that of a run: it has begun, failed, or ended.
    marks = {"config.yaml", FAILED_FILE, SUMMARY}
    # Not rglob, which raises where a folder goes while it is looked through.
    found = {Path(place).relative_to(folder).as_posix() for place, _, files in os.walk(folder) if marks & {*files}}
    inside = {name for name in named | found if _is_inside(root, name)}
    # `.` is the sweep's own folder, which is no run of it, unless it is the folder of a run itself.
    none = set() if (folder / "config.yaml").is_file() else {"."}
    return sorted((name for name in inside - none if not _is_block(folder / name)), key=_natural)


def _is_path(text: str) -> bool:
    try:
        path = os.fsencode(text)
    except UnicodeEncodeError:  # half of a surrogate pair, which JSON may hold and no path does
        return False
    return 0 < len(path) < _LONGEST and b"\0" not in path and max(map(len, path.split(b"/"))) <= _LONGEST_NAME


def _is_inside(root: str, name: str) -> bool:
    # With links followed, since `..` or a link within a name may lead anywhere. Not Path.resolve, which takes twice as
    # long, a matter of seconds in a plan of 100,000 runs, and raises at a link that leads to itself.
    return Path(os.path.realpath(f"{root}/{name}")).is_relative_to(root)


def _is_block(place: Path) -> bool:
    """Whether a folder is that of a block, whose run is part of another one: RUN/blocks/00012."""
    return place.parent.name == "blocks" and (place.parent.parent / "config.yaml").is_file()


def _relative(sweep: Iterable[str | Path], name: str) -> str:
    path = Path(name)
    if not path.is_absolute():
        return path.as_posix()
    # A plan may name folders absolutely, and the sweep's own may be given through a link.
    for base in sweep:
        if path.is_relative_to(base):
            return path.relative_to(base).as_posix()
    return path.name or "."


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key of a path: parts that are numbers by value, all others by text."""
    # Not `isdigit`: a raised two is a digit to it, which int() refuses, as it does thousands of digits.
    return [(int(part), "") if re.fullmatch(r"[0-9]{1,18}", part) else (-1, part) for part in name.split("/")]


def _repeated(runs: Iterable[FinishedRun]) -> list[Anomaly]:
    """Runs of one and the same config: the first counts."""
    first: dict[str, str] = {}
    return [
        Anomaly(run.name, f"the same config as {first[run.config_sha256]}, which counts")
        for run in runs
        # `setdefault` gives the name that came first, which for the first itself is its own.
        if first.setdefault(run.config_sha256, run.name) != run.name
    ]


def _mixed(runs: Sequence[FinishedRun], summaries: Sequence[Mapping[str, Any]]) -> Iterator[Anomaly]:
    """Runs made with other versions than most."""
    # Exact results are compared to many digits, and other versions of NumPy or torch round and draw otherwise.
    texts = [json.dumps(summary.get("versions", {}), sort_keys=True) for summary in summaries]
    if len(set(texts)) < 2:
        return
    usual = json.loads(Counter(texts).most_common(1)[0][0])
    for run, text in zip(runs, texts, strict=True):
        own = json.loads(text)
        other = [f"{k} {own.get(k, 'unknown')}, most have {usual.get(k)}" for k in usual if own.get(k) != usual.get(k)]
        if other:
            yield Anomaly(run.name, f"other versions: {'; '.join(other)}")


def _missing_seeds(grouped: Study) -> Iterator[Anomaly]:
    """Seeds, or all runs, that a method has in one world and not in another."""
    for method in grouped.methods:
        groups = {world: grouped.of(world, method) for world in grouped.worlds}
        seeds = {run.seed for runs in groups.values() for run in runs}
        for world, runs in groups.items():
            missing = sorted(seeds - {run.seed for run in runs})
            if runs and missing:
                yield Anomaly(f"{method}, {world}", f"seed {', '.join(map(str, missing))} missing")
        without = [world for world, runs in groups.items() if not runs]
        if without:
            yield Anomaly(method, f"no run in {len(without)} of {len(groups)} worlds: {'; '.join(without)}")


def _policies(folder: Path, grouped: Study) -> tuple[dict[str, Sensed], list[Anomaly]]:
    """Of each world and method the policy of the run in the middle, or of the one next to it that can be read."""
    found: dict[str, Sensed] = {}
    anomalies = []
    for runs in grouped.groups.values():
        settings = runs[0].settings
        # No motion is known that would say how often what is remembered comes about.
        if settings["kernel.name"] == "tracks" and settings.get("task.memory", "cell") != "cell":
            continue
        # The middle one by AIHTR: the best would flatter the method, and a mean of policies is not a policy.
        ranked = sorted(runs, key=lambda run: (run.figure("aihtr"), run.seed))
        middle = (len(ranked) - 1) / 2
        # Outwards from the middle, in case its file is damaged or was tidied away.
        for _, run in sorted(enumerate(ranked), key=lambda item: abs(item[0] - middle)):
            try:
                # Against the summary's digest: a policy copied from another run would be drawn under this one's name.
                check_files(folder / run.name, read_summary(folder / run.name), "policy.npz")
                place = folder / run.name
                size, t_max = grid_size(settings["grid.size"]), settings.get("grid.t_max")
                found[run.name] = read_sensed(place / "policy.npz", size, t_max, partial(_visits, place))
                break
            except UserError as error:
                anomalies.append(Anomaly(run.name, str(error).removeprefix(f"{folder / run.name}/")))
    return found, anomalies


def _motions(folder: Path, runs: Iterable[FinishedRun]) -> tuple[dict[str, MotionTable], list[Anomaly]]:
    """MotionTable and references of each world, from the `kernel.npz` of its first run."""
    found: dict[str, MotionTable] = {}
    seen, anomalies = set[str](), list[Anomaly]()
    for run in runs:
        # Bounds and Q_MDP are the world's: computed once, not for each of its runs.
        if world_key(run) in seen:
            continue
        seen.add(world_key(run))
        if run.settings["kernel.name"] == "tracks":
            continue  # no motion is known there
        try:
            check_files(folder / run.name, read_summary(folder / run.name), "kernel.npz")
            found[run.name] = _motion(_world_config(folder / run.name))
        except UserError as error:
            anomalies.append(Anomaly(run.name, f"its world cannot be built ({error})"))
    return found, anomalies


def _modelled(cfg: WorldConfig) -> Modelled:
    """The world of a run, whose target has a mode where its stored kernel is on (cell, mode)."""
    kernel = canonical_kernel(make(cfg.kernel, cfg.grid.size))
    modes = kernel.shape[0] // cfg.grid.num_cells
    return HiddenWorld(kernel, cfg.grid.size, modes=modes, **of_task(cfg)) if modes > 1 else build_world(cfg)


def _visits(place: Path, table: PolicyTable) -> Array:
    """`[keys]`, see `read_sensed`."""
    return visits_of_keys(_modelled(_world_config(place)), table)


def _motion(cfg: WorldConfig) -> MotionTable:
    """What maps show besides the policy; the motion only where it is drawn, cell by cell."""
    problem = _modelled(cfg)
    if isinstance(problem, HiddenWorld):
        world, bound = averaged(problem), cell_bound(problem)
    else:
        world, bound = problem, bounds.clocked(problem)
    m = world.num_cells
    drawn = world.kernel if m <= MOST_MAP_CELLS else sparse.csr_array(world.kernel.shape)
    # Where Q_MDP senses little, its value takes minutes and gigabytes on a large grid.
    simple = evaluate(problem, qmdp.solve(world)).value if m <= DIRECT_CELLS else np.full(m, np.nan)
    return MotionTable(drawn, simple, bound)


def _world_config(place: Path) -> WorldConfig:
    """A run's world with the motion that it stored as its table, whatever made the motion."""
    plain = plain_config(place)
    # The motion as it was stored, not drawn anew: another version of NumPy may draw another kernel from the same seed.
    kernel: dict[str, Any] = {field.name: False for field in dataclasses.fields(TableConfig)}
    kernel |= {"name": "table", "path": str(place / "kernel.npz")}
    parts = {key: plain.get(key) for key in ("grid", "cost", "sensor")}
    return world_of(OmegaConf.to_yaml(OmegaConf.create({"quiet": True, "kernel": kernel, **parts})))


def _manifest(plan: Mapping[str, Any] | None, summaries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Where the results come from; no path of the machine is kept."""
    line = plan.get("line", "") if plan else ""
    words = printable(line).split() if isinstance(line, str) else []
    return {
        # A report is passed on, and the folders of somebody's machine are no part of the result.
        "line": " ".join(word for word in words if not word.startswith(("hydra.sweep.dir=", "hydra.run.dir="))),
        "planned": len(plan["jobs"]) if plan else None,
        "wall_seconds": round(sum(float(summary["wall_seconds"]) for summary in summaries), 1),
        "cpu_seconds": round(sum(float(summary["cpu_seconds"]) for summary in summaries), 1),
        "versions": _counted(summary.get("versions") for summary in summaries),
        "machines": _counted(summary.get("machine") for summary in summaries),
    }


def _counted(entries: Iterable[Any]) -> list[dict[str, Any]]:
    """The different entries, the most frequent first, with the number of runs that have them."""
    counts = Counter(json.dumps(entry, sort_keys=True) for entry in entries if entry)
    return [{"runs": count, **json.loads(text)} for text, count in sorted(counts.items(), key=lambda x: (-x[1], x[0]))]
