"""Files of runs and sweeps: `summary.json`, and their state for other processes, also while they run.

A summary holds the results of a run, a digest of each file it belongs to, and one of itself. So a summary, a kernel,
a config or a policy copied from another run, or changed by hand, is noticed when the results are read. The digests
are no signatures: a forger can compute them anew.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

from trackmdp.config import TrainConfig, load_run_config
from trackmdp.durable import write_json, write_sealed
from trackmdp.errors import UserError
from trackmdp.training.lock import is_locked
from trackmdp.untrusted import TIMED, decoded, known_object, opened, read_object, unsealed

CONFIG, SUMMARY, METRICS = "config.yaml", "summary.json", "metrics.csv"
_FILES = (CONFIG, "problem.npz", METRICS, "policy.npz")
_LARGEST = 2**36
PLAN, FAILED_FILE, DONE = "sweep.json", "failed.json", "done.json"
"""Files: of a sweep; of a run that failed, of a run of another command than `train` that ended."""
PLAN_BYTES = 2**26
"""Bytes of the longest plan: 100,000 runs, as many as a sweep may have, of 670 bytes each."""


def write_summary(folder: Path, content: Mapping[str, Any]) -> None:
    """Write `summary.json` of the run in `folder`, once all its other files are there."""
    files = {name: _digest(folder / name) for name in _FILES if (folder / name).is_file()}
    write_sealed(folder / SUMMARY, {**content, "files": files})


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary of the run in `folder`, as it was written.

    Raises:
        UserError: there is none, or it is damaged or changed.
    """
    return unsealed(read_object(folder / SUMMARY), str(folder / SUMMARY))


def finished(cfg: TrainConfig, folder: Path) -> dict[str, Any] | None:
    """The summary of a run that has nothing left to do; None where there is none, or one of another config."""
    try:
        summary = read_summary(folder)
        check_files(folder, summary, CONFIG)
        saved = load_run_config(folder)
    except UserError:
        return None
    # `quiet` changes the terminal alone, but is in the config.
    return summary if replace(cfg, resume=None, quiet=saved.quiet) == saved else None


def check_files(folder: Path, summary: Mapping[str, Any], *names: str) -> None:
    """Check that the files `names`, by default all, are the ones that the run of `summary` left.

    Raises:
        UserError: one is missing, or is another.
    """
    known = summary.get("files")
    if not isinstance(known, Mapping):
        raise UserError(
            f"{folder / SUMMARY}: names no files; it is by another version of this program"
        )
    for name in names or known:
        if name not in known or known[name] != _digest(folder / name):
            raise UserError(
                f"{folder / name}: not the file that this run left, as its {SUMMARY} has it"
            )


def _digest(file: Path) -> str:
    """SHA-256 of a file; of `metrics.csv` without its columns of times, so that a run that is repeated has the same."""
    with opened(file, most=_LARGEST) as stream:
        if file.name != METRICS:
            return hashlib.file_digest(stream, "sha256").hexdigest()
        digest = hashlib.sha256()
        with decoded(str(file), "a table"):
            rows = csv.reader(io.TextIOWrapper(stream, "utf-8", newline=""))
            head = next(rows, [])
            timed = {place for place, name in enumerate(head) if TIMED.search(name)}
            for row in chain([head], rows):
                kept = [cell for place, cell in enumerate(row) if place not in timed]
                digest.update(f"{kept}\n".encode())
        return digest.hexdigest()


@dataclass(frozen=True)
class RunState:
    """One run of a sweep, as its folder shows it.

    Attributes:
        folder: of the run.
        overrides: its words.
        state: done, failed, running, cut (it can go on) or waiting (not begun).
        reason: why it failed, in one line.
        result: the content of `summary.json` (training) or `done.json`; of `failed.json` where it failed, else empty.
    """

    folder: Path
    overrides: tuple[str, ...]
    state: str
    reason: str = ""
    result: Mapping[str, Any] = field(default_factory=dict)


def write_plan(
    sweep: Path, command: str, line: str, jobs: Sequence[tuple[str, Sequence[str]]]
) -> None:
    """Write `sweep.json`: all runs planned, each with the name of its folder and its overrides."""
    planned = [{"folder": name, "overrides": list(words)} for name, words in jobs]
    write_json(sweep / PLAN, {"command": command, "line": line, "jobs": planned})


def run_of(folder: Path, overrides: tuple[str, ...] = ()) -> RunState:
    """One run, as its folder shows it."""
    # Asked first: a resumed run is running although an earlier failure or summary may still be in its folder.
    if is_locked(folder):
        return RunState(folder, overrides, "running")
    try:
        result = read_summary(folder)
    except UserError:  # none, or none that can be trusted
        result = known_object(folder / DONE)
    if result:
        return RunState(folder, overrides, "done", "", result)
    if failed := known_object(folder / FAILED_FILE):
        return RunState(folder, overrides, "failed", str(failed.get("reason", "")), failed)
    return RunState(folder, overrides, "cut" if (folder / "config.yaml").is_file() else "waiting")
