"""A sweep from its plan to its results: a table at the terminal, and `runs.csv`."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any, Self

from rich.console import Console

from trackmdp.app.prepare import shown
from trackmdp.app.sweep.launchers import threads_of
from trackmdp.app.sweep.plan import Job, progress
from trackmdp.app.sweep.process import STOP, Launch, fail, stop_all
from trackmdp.config import TrainConfig
from trackmdp.config.options import is_number
from trackmdp.config.resume import by_key, continued
from trackmdp.durable import csv_text, write_text
from trackmdp.errors import FAILED, USER_MISTAKE, Preempted, UserError
from trackmdp.notebook.card import counted_words, decimal
from trackmdp.signals import Signals
from trackmdp.training.display import table
from trackmdp.training.folders import (
    DONE,
    FAILED_FILE,
    SUMMARY,
    RunState,
    finished,
    run_of,
    write_plan,
)
from trackmdp.training.lock import locked
from trackmdp.untrusted import no_formula, reason

TABLE = "runs.csv"

_FIGURES = ("aihtr", "regret_per_step", "accuracy", "sensors_per_step", "frames")
_HELD_OUT = ("held_out_aihtr", "held_out_accuracy", "held_out_sensors_per_step")
"""Figures of runs on recordings; their other figures are on the validation tracks."""
_ROUNDS = 3
"""How often runs that a broken launcher left undone are launched."""


def sweep(
    folder: Path,
    command: str,
    line: str,
    batches: Iterable[Sequence[Job]],
    launch: Launch,
    console: Console,
) -> int:
    """Run the jobs that are not finished, and show the results of all; returns the exit status.

    Args:
        folder: of the sweep.
        command: the command to run.
        line: the typed command line.
        batches: the plan, in parts; the next one is asked for once the runs of one are over.
        launch: runs jobs.
        console: where the table is shown.

    Raises:
        UserError: the folder is in use, or a cluster to launch runs on is not there.
        Preempted: a signal ended the sweep; it can go on.
    """
    # By name, since a search may come upon a run that an earlier batch had.
    jobs: dict[str, Job] = {}
    skipped: set[Path] = set()
    # Two sweeps in one folder would start the same runs, and each remove the other's stop file.
    with locked(folder, "hydra.sweep.dir"), _Stop(folder) as stop:
        for batch in batches:
            jobs |= {job.name: job for job in batch}
            # Before anything is run, so that `report` and `watch` know the runs still to come.
            write_plan(folder, command, line, [(job.name, job.words) for job in jobs.values()])
            done = {
                job.folder for job in progress(batch, "looked up", console) if _is_finished(job)
            }
            before = f", {len(done)} of them done before" if done else ""
            console.print(f"{counted_words(len(batch), 'run')}{before} -> {shown(folder)}")
            _run([job for job in batch if job.folder not in done], launch, stop)
            skipped |= done
            if stop.received:
                break
        runs = [run_of(job.folder, job.words) for job in jobs.values()]
        write_table(folder, runs)
        show_runs(console, runs, skipped, folder)
    if stop.received:
        raise Preempted(stop.received)
    if failed := sum(run.state == "failed" for run in runs):
        sys.stderr.write(f"trackmdp {command}: {failed} of {len(runs)} runs failed\n")
    return status_of(runs)


def _is_finished(job: Job) -> bool:
    """Whether the run is done already, with the very config that is asked for."""
    # Other commands leave no config to compare with, so that they are done again.
    if not isinstance(job.cfg, TrainConfig) or run_of(job.folder).state != "done":
        return False
    if finished(job.cfg, job.folder):
        return True
    # Options of the run in the folder may differ where the line leaves them to their defaults.
    with suppress(UserError):  # one that must not change: the run refuses it itself
        return finished(continued(job.cfg, job.folder, job.words), job.folder) is not None
    return False


def _run(jobs: Sequence[Job], launch: Launch, stop: _Stop) -> None:
    """Launch `jobs`, and once more the ones that a broken launcher left undone."""
    for job in jobs:
        # A launcher's worker may die before its run begins; an old result would then be taken for the new one.
        for name in (FAILED_FILE, DONE, SUMMARY):
            (job.folder / name).unlink(missing_ok=True)
    why = "it was launched, and left nothing"
    # A pool gives up all its jobs when a worker is killed. Finished runs are in their folders, so that
    # the rest can simply be launched again.
    for _ in range(_ROUNDS):
        if not jobs or stop.received:
            return
        try:
            # Here and not in each launcher: the fork server, worker processes and their children all inherit the
            # environment.
            with threads_of(jobs):
                launch(jobs)
        except Exception as error:
            # No such cluster, or a file that cannot be written: the next round would meet the same.
            if isinstance(error, UserError) or getattr(error, "filename", None):
                raise
            why = f"the launcher broke down: {type(error).__name__}: {reason(error)}"
            sys.stderr.write(f"{why}\n")
        finally:
            stop_all()  # a launcher that broke down may still wait for runs in its threads
        # Not "running": another process holds that folder, and is at it.
        jobs = [job for job in jobs if run_of(job.folder).state in ("cut", "waiting")]
    for job in jobs if not stop.received else ():
        fail(job, why)


class _Stop(Signals):
    """A signal also asks the runs, in any process, to save and end."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._file = folder / STOP

    def __enter__(self) -> Self:
        self._file.unlink(missing_ok=True)
        return super().__enter__()

    def __exit__(self, *raised: Any) -> None:
        super().__exit__(*raised)
        if raised[0] is None:  # else jobs elsewhere may still be about to look
            self._file.unlink(missing_ok=True)

    def _note(self, number: int, frame: FrameType | None) -> None:
        try:
            # A file, since runs may be on other machines, where no signal reaches them. `finally`: with a full disk
            # the signal has still to be noted here.
            # Bytes: in a signal handler the first look-up of a codec may fail, which imports a module.
            self._file.write_bytes(b"%d" % number)
        finally:
            super()._note(number, frame)


def show_runs(
    console: Console, runs: Sequence[RunState], skipped: Collection[Path], sweep: Path
) -> None:
    """Every run with its state, AIHTR and regret per step, or why it failed."""
    # Without the digest, where the readable part is different for each run; one without words of its own has none.
    names = [run.folder.name.rpartition("-")[0] for run in runs]
    if len({"", *names}) <= len(names):
        names = [run.folder.name for run in runs]
    states = [
        "skipped" if run.folder in skipped and run.state == "done" else run.state for run in runs
    ]
    found = [run_figures(run) for run in runs]
    rows = [
        [name, state, decimal(has.get("aihtr")), decimal(has.get("regret_per_step"), 4), run.reason]
        for name, state, has, run in zip(names, states, found, runs, strict=True)
    ]
    aihtr = "validation AIHTR" if any("held_out_aihtr" in has for has in found) else "AIHTR"
    heads = ["run", "state", aihtr, "regret per step", "reason"]
    made = table(counted_words(len(runs), "run"), heads, rows)
    made.columns[1].justify = made.columns[4].justify = "left"
    console.print(made)
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    # `markup=False`: a folder named "[red]" is a name, not an order to rich.
    console.print(f"{counts}; {shown(sweep) / TABLE}")


def write_table(sweep: Path, runs: Sequence[RunState]) -> None:
    """Write `runs.csv`: folder, state, figures, reason, and one column for every option that was overridden.

    Nothing in it depends on time, or on how often a run was interrupted.
    """
    words = [by_key(run.overrides) for run in runs]
    # The union in order of appearance: runs of different blocks may have different options.
    keys = [key for key in dict.fromkeys(key for pairs in words for key in pairs) if key != "quiet"]
    found = [run_figures(run) for run in runs]
    names = [*_FIGURES, *(name for name in _HELD_OUT if any(name in each for each in found))]
    rows = [
        [
            _cell(run.folder.name),
            run.state,
            *(each.get(name) for name in names),
            _cell(run.reason),
            *(_cell(pairs.get(key)) for key in keys),
        ]
        for run, each, pairs in zip(runs, found, words, strict=True)
    ]
    write_text(sweep / TABLE, csv_text(["folder", "state", *names, "reason", *keys], rows))


def _cell(text: str | None) -> str | None:
    """Numbers as they are, also negative ones; a text that would be a formula is kept from being one."""
    return text if text is None or is_number(text) else no_formula(text)


def status_of(runs: Sequence[RunState]) -> int:
    """The exit status: 0 if all is done, 2 if only mistakes of the user failed, else 1."""
    # A run that is neither done nor failed is nobody's mistake, and 2 means to a script: do not try again.
    statuses = {run.result.get("status", FAILED) for run in runs if run.state != "done"}
    if not statuses:
        return 0
    return USER_MISTAKE if statuses == {USER_MISTAKE} else FAILED


def run_figures(run: RunState) -> dict[str, Any]:
    """The figures by which runs are compared; of another command than `train` the one value that it returns.

    On recordings they are those on the validation tracks: a choice by the held-out tracks would be the luckiest there.
    Of several targets they are of all together, also where the plan of a single one is merged.
    """
    if "policy" not in run.result:
        return {"aihtr": run.result.get("value")}
    policy, validation = run.result["policy"], run.result.get("validation")
    found = {name: run.result.get(name) for name in ("regret_per_step", "frames")}
    if validation:
        found |= {name: policy.get(name.removeprefix("held_out_")) for name in _HELD_OUT}
    several = run.result.get("several") or {}
    if (upper := several.get("upper")) is not None:
        policy = {name: each["mean"] for name, each in several["figures"].items()}
        found["regret_per_step"] = (upper - policy["aihtr"]) / several["expected_length"]
    return {**(validation or policy), **found}
