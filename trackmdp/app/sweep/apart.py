"""A run in a process of its own, so that nothing that happens to it happens to the others."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from trackmdp.app.prepare import announce, prepare
from trackmdp.app.sweep.plan import Job
from trackmdp.errors import FAILED, USER_MISTAKE, Preempted, RunError, UserError

__all__ = ["METHOD", "OUTPUT", "Outcome", "context_for", "end_all", "run_apart"]

OUTPUT = "output.txt"
"""File in a run's folder for what it says, where several runs would say it at once."""

METHOD = "forkserver"
"""The server imports the command once, on which seconds are spent, and every run begins as a copy of it."""

_running: list[Any] = []
_one_at_a_time = threading.RLock()
"""Held while a process is started or joined: either looks after all others that this process has started."""
_POLL = 0.2
_TERMINATING = (signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        status: as of the command line: 0, 1, 2, or 128 + the signal that stopped it.
        value: what the command returned.
        reason: why it failed.
    """

    status: int
    value: float | None = None
    reason: str = ""


def run_apart(job: Job, stop: Callable[[], int]) -> Outcome:
    """Run `job` in a child process and wait for it; `stop()` is the signal it is asked to stop by, 0 for none.

    The child saves and ends as well when the calling process goes, however it goes.
    """
    context = context_for(job.command)
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(job, Path.cwd(), theirs))
    with _one_at_a_time:
        process.start()
        _running.append(process)
    theirs.close()
    asked = 0
    try:
        while not wait([process.sentinel], _POLL):
            if not asked and (asked := stop()):
                process.terminate()
    finally:
        _end(process)  # an exception takes this process out of the loop: let the run save first
    return _outcome(ours, process.exitcode, asked)


def end_all() -> None:
    """Let the runs that this process waits for save and end, and wait for that."""
    for process in tuple(_running):
        _end(process)


def context_for(command: str) -> Any:
    """What starts processes for runs of `command`; called first in the main thread.

    Its server is deaf to signals that go to the whole group of processes, or it would leave the runs alone.
    """
    context: Any = multiprocessing.get_context(METHOD)
    if METHOD != "forkserver":
        return context
    context.set_forkserver_preload([f"trackmdp.app.commands.{command}"])
    deaf = _TERMINATING if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.signal(number, signal.SIG_IGN) for number in deaf}
    try:
        forkserver.ensure_running()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return context


def _end(process: Any) -> None:
    if not wait([process.sentinel], 0):
        process.terminate()
        wait([process.sentinel])
    with _one_at_a_time:
        process.join()
        if process in _running:
            _running.remove(process)


def _outcome(connection: Connection, code: int, asked: int) -> Outcome:
    """What the child told, or what its end tells."""
    with connection:
        try:
            told = connection.recv() if connection.poll() else None
        except EOFError:
            told = None
    if isinstance(told, Outcome):
        return told
    if asked:
        return Outcome(128 + asked)
    if code < 0:
        return Outcome(FAILED, reason=f"killed by {signal.Signals(-code).name}{_MEMORY if code == -9 else ''}")
    return Outcome(FAILED, reason=f"its process ended with status {code}")


_MEMORY = ", perhaps for lack of memory"


def _child(job: Job, folder: Path, connection: Connection) -> None:
    for number in (signal.SIGTERM, signal.SIGUSR1):
        signal.signal(number, signal.SIG_DFL)
    for number in (signal.SIGINT, signal.SIGUSR2):  # for the sweep, and for the job of a cluster; both pass it on
        signal.signal(number, signal.SIG_IGN)
    os.chdir(folder)
    if job.aside:
        with (job.folder / OUTPUT).open("a") as stream:
            sys.stdout.flush()
            os.dup2(stream.fileno(), 1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    outcome = _run(job)
    with connection:
        connection.send(outcome)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGUSR1)  # SIGTERM may have come before, and a second one ends it at once


def _run(job: Job) -> Outcome:
    """Run the command; nothing that it raises gets out."""
    assert job.cfg is not None
    try:
        ready = prepare(job.command, job.cfg, job.folder, job.words)
        announce(job.command, ready.cfg, job.folder, job.label)
        value = ready.run()
        return Outcome(0, float(value) if isinstance(value, (int, float)) else None)
    except Preempted as error:
        return Outcome(128 + error.signal)
    except (UserError, RunError) as error:
        return Outcome(USER_MISTAKE if isinstance(error, UserError) else FAILED, reason=_line(error))
    except BaseException as error:
        traceback.print_exc()
        sys.stderr.flush()
        return Outcome(FAILED, reason=f"{type(error).__name__}: {_line(error)}".removesuffix(": "))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
