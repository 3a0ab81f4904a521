"""One process in a run's folder at a time."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trackmdp.durable import UNSUPPORTED, remove_parts, reopen, report_lacking
from trackmdp.errors import RunError, UserError
from trackmdp.untrusted import opened

_LOCK = ".lock"
_LEAST, _BETWEEN = 0.2, 0.05
"""Seconds of trying, since `is_locked` of a watcher holds the lock for an instant; and between two tries."""


@contextmanager
def locked(folder: Path, key: str = "hydra.run.dir", *, wait: float = 0.0) -> Iterator[None]:
    """Lock the folder, which the option `key` names; the system releases the lock when the process ends, in any way.

    A file system without locks is reported in a line. The lock's file is removed where it is the only one.

    Args:
        folder: to lock.
        key: names the folder in messages.
        wait: seconds to wait for another process.

    Raises:
        UserError: another process holds it.
    """
    file = folder / _LOCK
    until = time.monotonic() + max(wait, _LEAST)
    while (descriptor := _taken(file)) is None:
        if time.monotonic() > until:
            raise UserError(f"{key}={folder}: another process is running in this folder")
        time.sleep(_BETWEEN)
    try:
        remove_parts(folder)
        yield
    finally:
        if folder.is_dir() and [each.name for each in folder.iterdir()] == [_LOCK]:
            file.unlink()
        os.close(descriptor)


@contextmanager
def locked_run(folder: Path, key: str = "hydra.run.dir") -> Iterator[None]:
    """`locked` around a training run, which can be resumed where a file could not be written.

    Raises:
        UserError: another process holds it.
        RunError: a file could not be written.
    """
    try:
        with locked(folder, key):
            yield
    except OSError as error:
        if not folder.is_dir():  # removed meanwhile: nothing to resume
            raise
        raise RunError(
            f"{error.filename or folder}: {error.strerror or error}; resume=auto resumes from the last checkpoint"
        ) from error


def _taken(file: Path) -> int | None:
    """The descriptor of the locked file; None where another process holds it."""
    descriptor = reopen(file)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A process that ended may have removed the file between our opening and locking it: nobody else would look at
        # a lock on a file without a name.
        if os.path.samestat(os.fstat(descriptor), file.stat()):
            return descriptor
    except OSError as error:
        if error.errno in UNSUPPORTED:
            report_lacking(file.parent, "locks", "start one process at a time in this folder")
            return descriptor
        if error.errno not in (errno.EAGAIN, errno.EACCES, errno.ENOENT):
            os.close(descriptor)
            raise
    os.close(descriptor)
    return None


def is_locked(folder: Path) -> bool:
    """Whether a process is running in the folder; false where its file system has no locks."""
    try:
        with opened(folder / _LOCK, most=2**20) as stream:
            # A shared lock: several watchers do not take each other for the owner.
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (OSError, UserError):
        return False
    return False
