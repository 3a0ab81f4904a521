"""Results of a sweep from its folder; runs that cannot be read are listed, the others are used."""

from __future__ import annotations

import json
import os
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

from trackmdp.errors import UserError
from trackmdp.reports.finished import read_map, read_run
from trackmdp.reports.grouping import Study, changed, study
from trackmdp.reports.results import Anomaly, FinishedRun, Mapped, Results
from trackmdp.training.folders import FAILED_FILE, PLAN, PLAN_BYTES, SUMMARY, run_of
from trackmdp.untrusted import decoded, known_object, printable

DRAWN = 2
"""Number of methods with pictures of their policies, in the first and in the last world."""


def gather_runs(folder: Path) -> Results:
    """Read every run below the folder of a sweep, finished or not.

    Raises:
        UserError: there is no run at all.
    """
    plan = planned(folder)
    names = run_folders(folder, plan)
    if not names:
        raise UserError(
            f"sweep={folder}: no runs in there, expected the folder of a sweep or of stored results"
        )
    lost: list[Anomaly] = []
    copies: list[Anomaly] = []
    found: dict[str, tuple[FinishedRun, Mapping[str, Any]]] = {}  # by all that decides a run
    for name in names:
        try:
            run, summary = _read(folder / name, name)
        except UserError as error:
            lost.append(_anomaly(folder, name, error))
            continue
        key = json.dumps({**run.settings, "quiet": ""}, sort_keys=True)
        first, _ = found.setdefault(key, (run, summary))
        if first is not run:  # a copied folder would count one seed twice
            copies.append(Anomaly(name, f"the same config as {first.name}, which counts"))
    runs, summaries = [run for run, _ in found.values()], [each for _, each in found.values()]
    maps, unread = _maps(folder, study(runs))
    other = "another world: a file that it names, as kernel.path, held something else than for"
    worlds = [Anomaly(name, f"{other} {known}") for name, known in changed(runs).items()]
    anomalies = [*lost, *copies, *worlds, *_other_versions(runs, summaries), *unread]
    return Results(runs, maps, anomalies, _manifest(plan, len(lost), runs, summaries))


def planned(folder: Path) -> Mapping[str, Any] | None:
    """The content of `sweep.json`, where there is a readable one."""
    plan = known_object(folder / PLAN, most=PLAN_BYTES)
    return plan if isinstance(plan.get("jobs"), list) else None


def run_folders(folder: Path, plan: Mapping[str, Any] | None) -> list[str]:
    """Folders of the runs, planned or found, relative to the folder of the sweep, in a fixed order.

    A planned folder outside of the sweep is left out.

    Raises:
        UserError: the plan names folders that no system has.
    """
    marks, root = {"config.yaml", FAILED_FILE, SUMMARY}, os.path.realpath(folder)
    # os.walk passes over a folder that is removed meanwhile; rglob raises.
    names = {
        os.path.relpath(place, folder) for place, _, files in os.walk(folder) if marks & {*files}
    }
    with decoded(f"sweep={folder}", f"the folder of a sweep with a {PLAN} of its runs"):
        for job in plan["jobs"] if plan else ():
            real = os.path.realpath(f"{folder}/{job['folder']}")
            if Path(real).is_relative_to(root):
                names.add(os.path.relpath(real, root))
    # The folder of the sweep itself is a run where it holds a config.
    names -= set() if (folder / "config.yaml").is_file() else {"."}
    # Without blocks of runs, such as RUN/blocks/00012.
    above = {name: (folder / name).parent for name in names}
    return sorted(
        name
        for name, place in above.items()
        if place.name != "blocks" or not (place.parent / "config.yaml").is_file()
    )


def _read(place: Path, name: str) -> tuple[FinishedRun, Mapping[str, Any]]:
    """A run and its summary.

    Raises:
        UserError: the run failed, is not finished, or cannot be read.
    """
    # The summary is written last: without it the figures are not final.
    if (place / SUMMARY).is_file():
        return read_run(place, name)
    if (place / FAILED_FILE).is_file():
        reason = known_object(place / FAILED_FILE).get("reason", "no reason given")
        raise UserError(f"failed: {reason}")
    reasons = {
        "waiting": "not started",
        "running": "still running",
        "cut": f"cut: it has no {SUMMARY}",
        "done": "done, but not by train",  # other commands leave files of their own
    }
    raise UserError(reasons[run_of(place).state])


def _anomaly(folder: Path, name: str, error: UserError) -> Anomaly:
    return Anomaly(printable(name), printable(str(error).replace(f"{folder / name}/", "")))


def _other_versions(
    runs: Sequence[FinishedRun], summaries: Sequence[Mapping[str, Any]]
) -> Iterator[Anomaly]:
    """Runs made with other versions than most: other versions round and draw otherwise."""
    counted = _counted(summary.get("versions") for summary in summaries)
    usual = counted[0] if counted else {}
    for run, summary in zip(runs, summaries, strict=True):
        own = _mapping(summary.get("versions"))
        other = [
            f"{name} {own.get(name, 'unknown')}, most have {value}"
            for name, value in usual.items()
            if name != "runs" and own.get(name) != value
        ]
        if other:
            yield Anomaly(run.name, f"other versions: {'; '.join(other)}")


def _maps(folder: Path, grouped: Study) -> tuple[list[Mapped], list[Anomaly]]:
    """The best methods in the first and the last world, which differ most; of each a run that can be read."""
    found, anomalies = [], []
    for world in dict.fromkeys((*grouped.worlds[:1], *grouped.worlds[-1:])):
        for method in _best(grouped, world):
            for run in _from_the_middle(grouped.of(world, method)):
                try:
                    drawn = read_map(folder / run.name, run, world, method)
                except UserError as error:
                    anomalies.append(_anomaly(folder, run.name, error))
                    continue
                found += [drawn] if drawn else []
                break
    return found, anomalies


def _best(grouped: Study, world: str) -> list[str]:
    """The methods of the largest median AIHTR in a world, in the order of the report."""
    values = {each: grouped.values(world, each, "aihtr") for each in grouped.methods}
    earned = {each: median(found) for each, found in values.items() if found}
    best = sorted(earned, key=earned.__getitem__)[-DRAWN:]
    return [each for each in grouped.methods if each in best]


def _from_the_middle(runs: Sequence[FinishedRun]) -> list[FinishedRun]:
    """Runs by their distance from the median AIHTR: the best run would flatter the method."""
    middle = median(run.figure("aihtr") for run in runs) if runs else 0.0
    return sorted(runs, key=lambda run: (abs(run.figure("aihtr") - middle), run.seed))


def _manifest(
    plan: Mapping[str, Any] | None,
    lost: int,
    runs: Sequence[FinishedRun],
    summaries: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Command, times, versions and machines of a sweep, without paths of the machine."""
    words: list[str] = []
    with suppress(ValueError):  # a line that no sweep wrote: quotes without an end
        words = shlex.split(printable(str(plan.get("line", "")))) if plan else []
    folders = ("hydra.sweep.dir=", "hydra.run.dir=")
    # The plan is of the last line typed in the folder, which may hold runs of earlier ones.
    planned = len(runs) + lost if plan else None
    return {
        "line": shlex.join(word for word in words if not word.startswith(folders)),
        "planned": planned,
        "last": bool(plan and planned and planned > len(plan["jobs"])),
        "wall_seconds": sum(run.figure("wall_seconds") for run in runs),
        "cpu_seconds": sum(run.figure("cpu_seconds") for run in runs),
        "versions": _counted(summary.get("versions") for summary in summaries),
        "machines": _counted(summary.get("machine") for summary in summaries),
    }


def _counted(entries: Iterable[Any]) -> list[dict[str, Any]]:
    """Different entries with their number of runs, the most frequent first; none that is no mapping."""
    counts = Counter(json.dumps(entry, sort_keys=True) for entry in map(_mapping, entries) if entry)
    return [
        {**json.loads(text), "runs": count}
        for text, count in sorted(counts.items(), key=lambda each: (-each[1], each[0]))
    ]


def _mapping(entry: Any) -> Mapping[str, Any]:
    return entry if isinstance(entry, Mapping) else {}
