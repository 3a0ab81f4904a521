"""The state of a sweep's runs, read from its folder while they run and afterwards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trackmdp.durable import write_json
from trackmdp.errors import UserError
from trackmdp.training.lock import is_locked
from trackmdp.training.sealing import read_summary
from trackmdp.untrusted import known_object

PLAN, FAILED_FILE, DONE = "sweep.json", "failed.json", "done.json"
"""Files: of a sweep; of a run that failed, of a run of another command than `train` that ended."""


@dataclass(frozen=True)
class RunState:
    """One run of a sweep, as its folder shows it.

    Attributes:
        folder: of the run.
        overrides: its words.
        state: done, failed, running, cut (it can go on) or waiting (not begun).
        reason: why it failed, in one line.
        result: the content of `summary.json` (training) or `done.json`; empty unless done.
    """

    folder: Path
    overrides: tuple[str, ...]
    state: str
    reason: str = ""
    result: Mapping[str, Any] = field(default_factory=dict)


def write_plan(sweep: Path, command: str, line: str, jobs: Sequence[tuple[str, Sequence[str]]]) -> None:
    """Write `sweep.json`: all runs planned, each with the name of its folder and its overrides."""
    planned = [{"folder": name, "overrides": list(words)} for name, words in jobs]
    write_json(sweep / PLAN, {"command": command, "line": line, "jobs": planned})


def read_plan(sweep: Path) -> dict[str, Any]:
    """The content of `sweep.json`: `command`, `line` and `jobs`.

    Raises:
        UserError: the folder is not that of a sweep.
    """
    content = known_object(sweep / PLAN)
    jobs = content.get("jobs")
    whole = isinstance(jobs, list) and all(
        isinstance(job, dict) and isinstance(job.get("folder"), str) and isinstance(job.get("overrides"), list)
        for job in jobs
    )
    if not whole or not content.keys() >= {"command", "line"}:
        raise UserError(f"sweep={sweep}: expected the folder of a sweep, with {PLAN}")
    return content


def runs_of(sweep: Path) -> list[RunState]:
    """All runs of a sweep, in the order planned.

    Raises:
        UserError: the folder is not that of a sweep.
    """
    return [run_of(sweep / job["folder"], tuple(job["overrides"])) for job in read_plan(sweep)["jobs"]]


def run_of(folder: Path, overrides: tuple[str, ...] = ()) -> RunState:
    """One run, as its folder shows it."""
    # Asked first: a resumed run is running although an earlier failure or summary may still be in its folder.
    if is_locked(folder):
        return RunState(folder, overrides, "running")
    if result := _result(folder):
        return RunState(folder, overrides, "done", "", result)
    if failed := known_object(folder / FAILED_FILE):
        return RunState(folder, overrides, "failed", str(failed.get("reason", "")))
    return RunState(folder, overrides, "cut" if (folder / "config.yaml").is_file() else "waiting")


def _result(folder: Path) -> dict[str, Any]:
    """What a run that is done left; empty where it left nothing, or nothing that can be trusted."""
    try:
        return read_summary(folder)
    except UserError:
        return known_object(folder / DONE)
