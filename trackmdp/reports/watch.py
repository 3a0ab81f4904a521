"""Progress of all runs of a sweep at the terminal, read from their folders while they run."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from trackmdp.errors import UserError
from trackmdp.reports.checks import LARGEST_FIGURE
from trackmdp.reports.gather import planned, run_folders
from trackmdp.training.folders import SUMMARY, run_of
from trackmdp.untrusted import decoded, known_object, opened, printable

_WAITING, _RUNNING, _CUT, _FAILED, _DONE = "waiting", "running", "cut", "failed", "done"
# A table of metrics may be large, and is looked at every few seconds for every run; its end is enough.
TAIL = 4096
"""Bytes read from the end of `metrics.csv`."""


@dataclass(frozen=True)
class Status:
    """Where a run is.

    Attributes:
        name: its folder.
        state: waiting, running, cut, failed or done.
        share: of its iterations, 0 to 1.
        gap: AIHTR missing to the upper bound, None while unknown.
        left: seconds to go, None while unknown.
        reason: why it failed.
    """

    name: str
    state: str
    share: float = 0.0
    gap: float | None = None
    left: float | None = None
    reason: str = ""


def watch(sweep: Path, console: Console, every: float) -> int:
    """Show the runs until nothing is left to wait for; returns how many are done.

    At a terminal a table stays in place; piped, a line comes for each run that has changed its state.

    Raises:
        UserError: there are no runs.
    """
    looks = _looks(sweep, every)
    found = first = next(looks)
    if not found:
        raise UserError(f"sweep={sweep}: no runs in there, expected the folder of a sweep")
    if console.is_terminal:
        # `auto_refresh=False`: a thread of rich's would draw between two looks at the disk, where nothing is new.
        with Live(_table(found, console.height), console=console, auto_refresh=False) as live:
            for found in looks:
                live.update(_table(found, console.height), refresh=True)
    else:
        said: dict[str, str] = {}  # name -> the state last told
        for found in chain([first], looks):
            for status in found:
                if status.state != _WAITING and said.get(status.name) != status.state:
                    said[status.name] = status.state
                    console.print(printable(_line(status)), markup=False)
        console.print(_counts(found), markup=False)
    return sum(status.state == _DONE for status in found)


def statuses(sweep: Path) -> list[Status]:
    """The runs as they are now."""
    return [_status(sweep / name, name) for name in run_folders(sweep, planned(sweep))]


def _looks(sweep: Path, every: float) -> Iterator[list[Status]]:
    """The runs, again and again until nothing is left to wait for."""
    while True:
        yield (found := statuses(sweep))
        if not _going(sweep, found):
            return
        time.sleep(every)


def _going(sweep: Path, found: Sequence[Status]) -> bool:
    """Whether anything is left to wait for: a run under way, or one that the sweep, still running, has to begin."""
    # "cut" or "waiting" with the sweep still running means: still to come; without it nothing will come, and watching
    # ends.
    states = {status.state for status in found}
    return _RUNNING in states or (bool(states & {_WAITING, _CUT}) and run_of(sweep).state == _RUNNING)


def _status(place: Path, name: str) -> Status:
    found, plan = run_of(place), known_object(place / "plan.json")
    if found.state == _FAILED:
        return Status(name, _FAILED, reason=found.reason)
    # The run is being written while it is read: a file may be missing, or of the moment before.
    upper, last = _number(plan, "upper_bound"), _last_rows(place / "metrics.csv")
    if found.state == _DONE:
        summary = found.result
        earned, best = _number(summary.get("policy"), "aihtr"), _number(summary.get("optimal"), "upper")
        bounds = [bound for bound in (upper, best) if bound is not None]
        # The solver's bound may be tighter than the clocked one of the plan.
        return Status(name, _DONE, 1.0, min(bounds) - earned if bounds and earned is not None else None, 0.0)
    if not last:  # not begun, or a run by blocks, each of which has metrics of its own
        done, blocks = len([*place.glob(f"blocks/*/{SUMMARY}")]), _number(plan, "blocks") or 0.0
        return Status(name, found.state, min(1.0, done / blocks) if blocks >= 1 else 0.0)
    planned = _number(plan, "iterations") or 0.0
    share = min(1.0, last[-1]["iteration"] / planned) if planned >= 1 else 0.0
    judged = [row["aihtr"] for row in last if "aihtr" in row]
    gap = upper - judged[-1] if judged and upper is not None else None
    # As if every iteration took the same time.
    left = last[-1]["seconds"] * (1 - share) / share if share else None
    return Status(name, found.state, share, gap, left)


def _number(said: Any, key: str) -> float | None:
    """The number under `key`; None where there is none: the file may be another program's."""
    value = said.get(key) if isinstance(said, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    # Comparing is false for nan, so that it is left out like what is too large.
    return float(value) if abs(value) < LARGEST_FIGURE else None


def _last_rows(file: Path) -> list[dict[str, float]]:
    """The numbers of the last whole rows of a table that is being written; none where it is no such table."""
    try:
        with opened(file, most=2**40) as stream, decoded(str(file), "a table"):
            head = stream.readline(TAIL).decode()
            # Not before the end of the heading, which was read on its own.
            begin = max(stream.tell(), stream.seek(0, os.SEEK_END) - TAIL)
            cut = begin > len(head.encode())
            stream.seek(begin)
            lines = stream.read(TAIL).decode(errors="replace").split("\n")
            # Begun in the middle, the first line is only the end of one.
            lines = lines[1 if cut else 0 : -1]  # the last one may be half written
            names = next(csv.reader([head]), [])
            rows = [dict(zip(names, row, strict=True)) for row in csv.reader(lines) if len(row) == len(names)]
            wanted = ("iteration", "seconds", "aihtr")
            # A row without an evaluation has an empty field for the AIHTR.
            found = [{key: float(row[key]) for key in wanted if row.get(key)} for row in rows]
    except UserError:
        return []
    whole = [row for row in found if row.keys() >= {"iteration", "seconds"}]
    return [
        row for row in whole if all(abs(value) < LARGEST_FIGURE for value in row.values()) and row["iteration"] >= 1
    ]


def _table(found: Sequence[Status], height: int) -> Group:
    shown = Table(expand=False)
    for label in ("run", "state", "progress", "gap", "left"):
        shown.add_column(label, justify="left" if label in ("run", "state") else "right")
    order = {_RUNNING: 0, _FAILED: 1, _CUT: 2, _WAITING: 3, _DONE: 4}
    # Frame and heading take four lines, what follows the table two. A table higher than the terminal could not be
    # redrawn in place.
    room = max(3, height - 6)
    ordered = sorted(found, key=lambda status: order[status.state])
    for status in ordered[:room]:
        # `Text`: rich would take "[red]" in a name for markup.
        shown.add_row(Text(printable(status.name)), Text(printable(status.reason or status.state)), *_figures(status))
    more = [Text(f"and {len(found) - room} more")] if len(found) > room else []
    return Group(shown, *more, Text(_counts(found)))


def _figures(status: Status) -> tuple[str, str, str]:
    gap = "" if status.gap is None else f"{status.gap:,.2f}"
    left = "" if status.left is None or status.state != _RUNNING else f"{status.left:,.0f} s"
    return f"{100 * status.share:.0f} %", gap, left


def _line(status: Status) -> str:
    share, gap, left = _figures(status)
    words = [f"{status.name}: {status.state}"]
    if status.reason:
        words.append(status.reason)
    if status.state in (_RUNNING, _CUT):
        words.append(share)
    words += [f"gap {gap}"] * bool(gap) + [f"{left} left"] * bool(left)
    return ", ".join(words)


def _counts(found: Sequence[Status]) -> str:
    states = [status.state for status in found]
    parts = [
        f"{states.count(state)} {state}" for state in (_DONE, _RUNNING, _FAILED, _CUT, _WAITING) if state in states
    ]
    return f"{len(found)} runs: {', '.join(parts)}"
