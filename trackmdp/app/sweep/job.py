"""One job of a sweep, in whatever process a launcher calls it: it never raises, and leaves its state on disk."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from trackmdp.app.outputs import remove_if_empty
from trackmdp.app.prepare import say
from trackmdp.app.sweep.plan import Job
from trackmdp.app.sweep.process import Outcome, run_in_process
from trackmdp.config import TrainConfig
from trackmdp.durable import write_json
from trackmdp.errors import USER_MISTAKE
from trackmdp.training.folders import DONE, FAILED_FILE, SUMMARY, run_of

Launch = Callable[[Sequence[Job]], None]
"""Runs jobs, and returns once none of them is running."""

STOP = ".stop"
"""File in a sweep's folder that holds the number of the signal by which all its runs are asked to stop."""

_PATIENCE = 60.0
"""Seconds to wait for a run's folder that an earlier process, which lost its sweep, still holds while it saves."""


def run_job(job: Job) -> None:
    """Run `job`, unless the sweep has been asked to stop; its result or failure is written to the run's folder."""
    if stop_signal(job.sweep):
        return
    job.folder.mkdir(parents=True, exist_ok=True)
    # A run whose sweep was killed saves and ends by itself, which takes a while; started beside it, this one would be
    # refused by the lock of the folder.
    if not _is_free(job):
        _say(job, "is run by another process")
        return
    # An earlier attempt in this folder, perhaps on a node that died, must not decide what this one came to.
    (job.folder / FAILED_FILE).unlink(missing_ok=True)
    (job.folder / DONE).unlink(missing_ok=True)
    if job.cfg is None:
        fail(job, Outcome(USER_MISTAKE, reason=job.refusal))
        return
    outcome = run_in_process(job, lambda: stop_signal(job.sweep))
    if outcome.status == 0:
        _done(job, outcome)
    elif outcome.reason:
        fail(job, outcome)
    # Stopped by a signal that the sweep knows nothing of, such as a kill by hand: a failure, else it would look
    # unfinished.
    elif not stop_signal(job.sweep):
        fail(job, Outcome(outcome.status, reason=f"stopped by signal {outcome.status - 128}"))
    remove_if_empty([job.folder])


def fail(job: Job, outcome: Outcome) -> None:
    """Leave in the run's folder why it failed, and say so."""
    job.folder.mkdir(parents=True, exist_ok=True)
    write_json(job.folder / FAILED_FILE, {"reason": outcome.reason, "status": outcome.status})
    _say(job, f"failed: {outcome.reason}")


def stop_signal(sweep: Path) -> int:
    """The signal by which the sweep was asked to stop; 0 for none."""
    try:
        # Empty while it is being written; 0 then, and the next look finds the number.
        return int((sweep / STOP).read_text(encoding="ascii") or 0)
    except (OSError, ValueError):
        return 0


def _done(job: Job, outcome: Outcome) -> None:
    # A training run leaves `summary.json` itself, and only where it came to its end.
    if not (isinstance(job.cfg, TrainConfig) and (job.folder / SUMMARY).is_file()):
        write_json(job.folder / DONE, {"value": outcome.value})
    if job.concurrent and job.cfg is not None and not job.cfg.quiet:
        value = f": AIHTR {outcome.value:,.3f}" if outcome.value is not None else ""
        say(f"({job.label}) {job.name} done{value}")


def _is_free(job: Job) -> bool:
    """Whether no process runs in the folder; one that lost its sweep is waited for, while it saves."""
    until = time.monotonic() + _PATIENCE
    while run_of(job.folder).state == "running":
        if time.monotonic() > until or stop_signal(job.sweep):
            return False
        time.sleep(0.1)
    return True


def _say(job: Job, what: str) -> None:
    # The terminal may be gone, as after a lost connection; the run is not to fail of that.
    with contextlib.suppress(OSError):
        sys.stderr.write(f"trackmdp {job.command}: {job.name} {what}\n")
