"""Progress of all runs of a sweep at the terminal, read from their folders while they run."""

from __future__ import annotations

import math
import os
import time
from collections import Counter
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
from trackmdp.notebook.card import counted_words
from trackmdp.reports.gather import planned, run_folders
from trackmdp.training.folders import METRICS, SUMMARY, run_of
from trackmdp.untrusted import decoded, known_object, opened, printable

_ORDER = ("running", "failed", "cut", "waiting", "done")
"""States, in the order of the table."""
TAIL = 4096
"""Bytes read from the end of `metrics.csv`, which may be long."""


@dataclass(frozen=True)
class Status:
    """State of a run.

    Attributes:
        name: folder.
        state: waiting, running, cut, failed or done.
        share: of its iterations, 0 to 1.
        gap: AIHTR missing to the upper bound, None while unknown.
        left: seconds to go, None while unknown.
        least: whether the last iteration may take longer than all others.
        reason: of a failure.
    """

    name: str
    state: str
    share: float = 0.0
    gap: float | None = None
    left: float | None = None
    least: bool = False
    reason: str = ""

    @property
    def cells(self) -> list[str]:
        """Name, state or reason, progress, gap and time left as they are shown."""
        share = f"{100 * self.share:.0f} %" if self.state in ("running", "cut") else ""
        gap = "" if self.gap is None else f"gap {self.gap:,.2f}"
        left = ""
        if self.left is not None and self.state == "running":
            left = f"{'at least ' if self.least else ''}{self.left:,.0f} s left"
        reason = f": {self.reason}" if self.reason else ""
        return [printable(self.name), printable(f"{self.state}{reason}"), share, gap, left]


def watch(sweep: Path, console: Console, every: float) -> None:
    """Show the runs until none is left to wait for.

    At a terminal a table stays in place; piped, each change of a state is a line.

    Raises:
        UserError: there are no runs.
    """
    looks = _looks(sweep, every)
    found = first = next(looks)
    if not found:
        raise UserError(f"sweep={sweep}: no runs in there, expected the folder of a sweep")
    if console.is_terminal and not console.is_dumb_terminal:
        # `auto_refresh=False`: a thread would draw between two looks at the disk.
        with Live(_table(found, console.height), console=console, auto_refresh=False) as live:
            for found in looks:
                live.update(_table(found, console.height), refresh=True)
    else:
        shown: dict[str, str] = {}
        for found in chain([first], looks):
            for status in found:
                if status.state not in ("waiting", shown.get(status.name)):
                    shown[status.name] = status.state
                    name, *rest = status.cells
                    console.print(f"{name}: {', '.join(filter(None, rest))}")
        console.print(_counts(found))


def statuses(sweep: Path) -> list[Status]:
    """The runs as they are now."""
    return [_status(sweep / name, name) for name in run_folders(sweep, planned(sweep))]


def _looks(sweep: Path, every: float) -> Iterator[list[Status]]:
    """The runs, again and again, while one is running, or the sweep has one to begin."""
    while True:
        yield (found := statuses(sweep))
        states = {status.state for status in found}
        to_come = states & {"waiting", "cut"} and run_of(sweep).state == "running"
        if "running" not in states and not to_come:
            return
        time.sleep(every)


def _status(place: Path, name: str) -> Status:
    found, plan = run_of(place), known_object(place / "plan.json")
    bound = _number(plan, "upper_bound")
    if found.state == "failed":
        return Status(name, found.state, reason=found.reason)
    if found.state == "done":
        earned = _number(found.result.get("policy"), "aihtr")
        # The bound of the solver may be tighter than the clocked one of the plan.
        best = _number(found.result.get("optimal"), "upper")
        return Status(name, found.state, 1.0, _gap(earned, bound, best), 0.0)
    row = _last_row(place / METRICS)
    if not row:  # not begun, or a run by blocks, which have metrics of their own
        done = len([*place.glob(f"blocks/*/{SUMMARY}")])
        return Status(name, found.state, done / (_number(plan, "blocks") or 1.0) if done else 0.0)
    share = min(1.0, row["iteration"] / (_number(plan, "iterations") or math.inf))
    # As if every iteration took the same time.
    left = row["seconds"] * (1 - share) / share if share else None
    least = bool(plan.get("least")) and share < 1
    return Status(name, found.state, share, _gap(row.get("aihtr"), bound), left, least)


def _gap(earned: float | None, *bounds: float | None) -> float | None:
    known = [bound for bound in bounds if bound is not None]
    return min(known) - earned if known and earned is not None else None


def _number(content: Any, key: str) -> float | None:
    """The number under `key`; None where there is none."""
    value: Any = content.get(key) if isinstance(content, Mapping) else None
    return float(value) if type(value) in (int, float) else None


def _last_row(file: Path) -> dict[str, float]:
    """The last whole row of a `metrics.csv` that is being written, with the last AIHTR; empty without a row."""
    found: dict[str, float] = {}
    try:
        with opened(file, most=2**40) as stream, decoded(str(file), "a table"):
            names = stream.readline().decode().strip().split(",")
            head = stream.tell()
            cut = stream.seek(max(head, stream.seek(0, os.SEEK_END) - TAIL)) > head
            # Without the first line, where it is the end of one, and the last one, which may be half written.
            for line in stream.read().decode().split("\n")[cut:-1]:
                row = dict(zip(names, line.split(","), strict=True))
                # Only some rows have an AIHTR.
                found |= {k: float(row[k]) for k in ("iteration", "seconds", "aihtr") if row[k]}
    except UserError:
        return {}
    return found if found.keys() >= {"iteration", "seconds"} else {}


def _table(found: Sequence[Status], height: int) -> Group:
    shown = Table("run", "state", "progress", "gap", "left")
    # Frame, heading and the lines below take six; a table higher than the terminal could not be redrawn in place.
    room = max(3, height - 6)
    for status in sorted(found, key=lambda status: _ORDER.index(status.state))[:room]:
        shown.add_row(
            *map(Text, status.cells)
        )  # `Text`: rich would take "[red]" in a name for markup
    more = [Text(f"and {len(found) - room} more")] if len(found) > room else []
    return Group(shown, *more, Text(_counts(found)))


def _counts(found: Sequence[Status]) -> str:
    counts = Counter(status.state for status in found)
    order = ("done", "running", "failed", "cut", "waiting")
    parts = (f"{counts[state]} {state}" for state in order if counts[state])
    return f"{counted_words(len(found), 'run')}: {', '.join(parts)}"
