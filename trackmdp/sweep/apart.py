"""A run in a process of its own, so that nothing that happens to it happens to the others."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from trackmdp.config import CommandConfig, TrainConfig
from trackmdp.config.resume import continued
from trackmdp.errors import FAILED, USER_MISTAKE, Preempted, RunError, UserError
from trackmdp.prepare import announce, check_files
from trackmdp.sweep.plan import Job

__all__ = ["METHOD", "Outcome", "run_apart"]

METHOD = "forkserver"
"""The server imports the command once, on which seconds are spent, and every run begins as a copy of it."""

_POLL = 0.2


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
    context: Any = multiprocessing.get_context(METHOD)
    if METHOD == "forkserver":
        context.set_forkserver_preload([f"trackmdp.commands.{job.command}"])
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(job, Path.cwd(), theirs))
    process.start()
    theirs.close()
    asked = 0
    try:
        while process.is_alive():
            process.join(_POLL)
            if not asked and (asked := stop()):
                process.terminate()
    finally:
        if process.is_alive():  # an exception takes this process out of the loop: let the run save first
            process.terminate()
            process.join()
    return _outcome(ours, process.exitcode, asked)


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
    os.chdir(folder)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    outcome = _run(job)
    with connection:
        connection.send(outcome)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _run(job: Job) -> Outcome:
    """Run the command; nothing that it raises gets out."""
    assert job.cfg is not None
    try:
        check_files(job.cfg, job.words)
        cfg: CommandConfig = job.cfg
        if isinstance(cfg, TrainConfig):
            cfg = continued(cfg, job.folder, job.words)
        announce(job.command, cfg, job.folder, job.label)
        run: Callable[[Any, Path], Any] = importlib.import_module(f"trackmdp.commands.{job.command}").run
        value = run(cfg, job.folder)
        return Outcome(0, float(value) if isinstance(value, (int, float)) else None)
    except Preempted as error:
        return Outcome(128 + error.signal)
    except KeyboardInterrupt:
        return Outcome(128 + signal.SIGINT)
    except (UserError, RunError) as error:
        return Outcome(USER_MISTAKE if isinstance(error, UserError) else FAILED, reason=_line(error))
    except BaseException as error:
        traceback.print_exc()
        sys.stderr.flush()
        return Outcome(FAILED, reason=f"{type(error).__name__}: {_line(error)}".removesuffix(": "))


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
