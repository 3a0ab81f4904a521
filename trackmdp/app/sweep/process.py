"""One run of a sweep in a process of its own: a crash, a leak or a kill in one run does not reach the others.

In any launcher's process, it never raises, and leaves its state on disk.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from trackmdp.app.prepare import announce, check, remove_if_empty, say
from trackmdp.app.sweep.plan import Job
from trackmdp.config import TrainConfig
from trackmdp.durable import write_json
from trackmdp.errors import FAILED, USER_MISTAKE, Preempted, RunError, UserError
from trackmdp.solvers.workers import end_with_parent, starting
from trackmdp.terminal import outlast_terminal
from trackmdp.training.folders import DONE, FAILED_FILE, SUMMARY, run_of
from trackmdp.untrusted import reason

Launch = Callable[[Sequence[Job]], None]
"""Runs jobs, and returns once none of them is running."""

STOP = ".stop"
"""File in a sweep's folder that holds the number of the signal by which all its runs are asked to stop."""

_PATIENCE = 60.0
"""Seconds to wait for a run's folder that an earlier process, which lost its sweep, still holds while it saves."""

OUTPUT = "output.txt"
"""File in a run's folder for its output, where several runs print at once."""

# For `stop_all`, which a scheduler's signal calls while another function waits for the process.
_running: list[Any] = []
_start_or_join = threading.RLock()
"""Held while a process is started or joined: `multiprocessing` polls all children in both, which is not thread-safe."""
# Seconds between two looks for the file that stops a sweep.
_POLL = 0.2
_LOST = 255
"""Exit status that `multiprocessing` gives to a process without its fork server."""
_TERMINATING = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


def run_in_process(job: Job) -> int | None:
    """Run `job` in a child process and wait for it.

    The child leaves its result, or why it failed, in the run's folder. It also saves and stops when the calling process
    ends, even by SIGKILL.

    Returns:
        Its exit status, -N where signal N killed it; None where `stop_all` has ended it, in another thread.
    """
    # The fork server is a process of its own, which the system may kill for lack of memory. The attempt that meets a
    # dead one fails, the next starts another; if that fails as well, something else is wrong.
    for last in (False, True):
        try:
            process, ours = _start(job)
            break
        except (OSError, EOFError) as error:  # the next start makes another fork server
            if last:
                _note(job, f"its process could not be started ({reason(error)})")
                return FAILED
    asked = False
    try:
        # The run outlives a killed fork server, which then cannot report how it ends; its own pipe closes when it does.
        while not wait([process.sentinel], _POLL) or (
            process.exitcode == _LOST and not ours.poll(_POLL)
        ):
            if not asked and (asked := stop_signal(job.sweep) > 0):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGTERM)
    finally:
        stopped = process not in _running
        # After an exception in this process the run may still be going: let it save first.
        _stop(process)
        ours.close()
    return None if stopped else int(process.exitcode)


def _start(job: Job) -> tuple[Any, Connection]:
    """The process of a run, and the end of a pipe that closes when it ends."""
    # The fork server imports the preloaded modules when it starts, so they are named before the first process.
    context = context_for(job.command)
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_run_in_child, args=(job, Path.cwd(), theirs))
    # Our copy of the writing end is closed once the child has its own: else the pipe would never report its end.
    with theirs, _start_or_join:
        process.start()
        _running.append(process)
    return process, ours


def stop_all() -> None:
    """Ask every run that this process waits for to save and stop, and wait until they have."""
    while _running:
        _stop(_running.pop())


def context_for(command: str) -> Any:
    """The `multiprocessing` context that starts runs of `command`.

    The fork server blocks the signals that a terminal or a scheduler sends to the whole process group: a run that it
    has forked needs it to report how it ended.
    """
    context: Any = multiprocessing.get_context("forkserver")
    # Importing torch takes seconds and memory: the server does it once, and every run of any launcher is forked from
    # it. Forking this process itself would copy its threads' locks in any state; a fork server has one thread.
    context.set_forkserver_preload([f"trackmdp.app.commands.{command}"])
    with starting(*_TERMINATING):
        forkserver.ensure_running()
    return context


def _stop(process: Any) -> None:
    if not wait([process.sentinel], 0):
        process.terminate()
        wait([process.sentinel])
    with _start_or_join:
        process.join()
        if process in _running:
            _running.remove(process)


def _run_in_child(job: Job, folder: Path, connection: Connection) -> None:
    # The sweep, or the cluster's job, receives these and passes them on.
    for number in (signal.SIGINT, signal.SIGUSR2):
        signal.signal(number, signal.SIG_IGN)
    # The fork server blocks them, and a fork inherits that: a run has to hear what it was sent meanwhile.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _TERMINATING)
    # The fork server stays in the folder in which it was started, so that relative paths would be meant from there.
    os.chdir(folder)
    outlast_terminal()
    # At the level of the descriptor, so that output of libraries in C goes to the file as well. Errors stay on the
    # terminal.
    if job.concurrent:
        with (job.folder / OUTPUT).open("a") as stream:
            sys.stdout.flush()
            os.dup2(stream.fileno(), 1)
    # A parent that is killed sends no signal to its children: they would go on alone, and hold their folders' locks.
    # Not by SIGTERM: where one came before, a second ends the run without saving.
    end_with_parent(lambda: os.kill(os.getpid(), signal.SIGUSR1))
    with connection:
        try:
            status = _run(job)
        except OSError as error:  # on a full disk not even the reason can be left
            _say(job, f"failed: {_line(error)}")
            status = FAILED
        sys.exit(status)


def _run(job: Job) -> int:
    """Run the command, and leave its result in the folder, or why it failed; returns the exit status."""
    assert job.cfg is not None
    try:
        # Checked when the sweep was planned, but hours may lie between, and files may have gone since.
        ready = check(job.command, job.cfg, job.folder, job.words)
        announce(ready, job.label)
        value = ready.run()
    except Preempted as error:
        return 128 + error.signal
    except (UserError, RunError) as error:
        status = USER_MISTAKE if isinstance(error, UserError) else FAILED
        _note(job, _line(error), status)
        return status
    # Any exception, SystemExit among them: it ends with this process, and the sweep needs a reason.
    except BaseException as error:
        traceback.print_exc()
        _note(job, f"{type(error).__name__}: {_line(error)}".removesuffix(": "))
        return FAILED
    # A training run leaves `summary.json` itself, and only where it came to its end.
    if not (isinstance(job.cfg, TrainConfig) and (job.folder / SUMMARY).is_file()):
        number = isinstance(value, (int, float))
        write_json(job.folder / DONE, {"value": float(value) if number else None})
    return 0


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())


def run_job(job: Job) -> None:
    """Run `job`, unless the sweep has been asked to stop; its result or failure is written to the run's folder."""
    if stop_signal(job.sweep):
        return
    job.folder.mkdir(parents=True, exist_ok=True)
    # A run of a killed sweep saves and ends by itself, which takes a while; started beside it, this one would be
    # refused by the lock of the folder.
    if not _is_free(job):
        _say(job, "is run by another process")
        return
    # An earlier attempt in this folder, perhaps on a node that died, must not decide the outcome of this one.
    (job.folder / FAILED_FILE).unlink(missing_ok=True)
    (job.folder / DONE).unlink(missing_ok=True)
    if job.cfg is None:
        fail(job, job.refusal, USER_MISTAKE)
        return
    status = run_in_process(job)
    run = run_of(job.folder)
    if run.state == "failed":
        _say(job, f"failed: {run.reason}")
    elif run.state == "done":
        value = run.result.get("value", run.result.get("policy", {}).get("aihtr"))
        shown = f": AIHTR {value:,.3f}" if value is not None else ""
        if job.concurrent and not job.cfg.quiet:
            say(f"({job.label}) {job.name} done{shown}")
    # One that ended without a word was stopped, unless nobody has asked it or the sweep to stop.
    elif status is not None and not stop_signal(job.sweep):
        fail(job, _ended(status))
    remove_if_empty([job.folder])


def _ended(status: int) -> str:
    """How a process ended, by its exit status."""
    if status < 0:
        # Linux sends 9 when memory runs out.
        memory = ", perhaps for lack of memory" if status == -9 else ""
        return f"killed by {signal.Signals(-status).name}{memory}"
    # Stopped by a signal that the sweep knows nothing of, such as a kill by hand.
    return (
        f"stopped by signal {status - 128}"
        if status > 128
        else f"its process ended with status {status}"
    )


def fail(job: Job, why: str, status: int = FAILED) -> None:
    """Leave the reason of the failure in the run's folder, and print it."""
    job.folder.mkdir(parents=True, exist_ok=True)
    _note(job, why, status)
    _say(job, f"failed: {why}")


def _note(job: Job, why: str, status: int = FAILED) -> None:
    write_json(job.folder / FAILED_FILE, {"reason": why, "status": status})


def stop_signal(sweep: Path) -> int:
    """The signal by which the sweep was asked to stop; 0 for none."""
    try:
        # Empty while it is being written; 0 then, and the next look finds the number.
        return int((sweep / STOP).read_bytes() or 0)
    except (OSError, ValueError):
        return 0


def _is_free(job: Job) -> bool:
    """Whether no process runs in the folder; one that lost its sweep is waited for, while it saves."""
    until = time.monotonic() + _PATIENCE
    while run_of(job.folder).state == "running":
        if time.monotonic() > until or stop_signal(job.sweep):
            return False
        time.sleep(0.1)
    return True


def _say(job: Job, state: str) -> None:
    # The terminal may be gone, as after a lost connection; the run is not to fail of that.
    with contextlib.suppress(OSError):
        sys.stderr.write(f"trackmdp {job.command}: {job.name} {state}\n")
