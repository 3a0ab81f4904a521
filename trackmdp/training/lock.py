"""One process per run folder."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from trackmdp.durable import UNSUPPORTED, create, reopen, say_lacking
from trackmdp.errors import UserError
from trackmdp.untrusted import known_object, opened

_TRIES, _BETWEEN = 5, 0.05
_LOCK, _OWNER = ".lock", ".lock.owner"
_BEAT, _SILENT = 5.0, 60.0
"""Seconds between two signs of life of an owner, and without one after which it counts as gone."""

_SETTLE = 0.2


@contextmanager
def locked(folder: Path, key: str = "hydra.run.dir", *, wait: float = 0.0) -> Iterator[None]:
    """Lock the folder, which the option `key` names; the system releases the lock when the process ends, in any way.

    For up to `wait` seconds it waits for another process, if the file system has locks. Where it has none, a file names
    the owner and is touched every few seconds. Where nothing else was written, the lock's files are gone afterwards as
    well.

    Raises:
        UserError: another process holds it, or the lock is no ordinary file.
    """
    file = folder / _LOCK
    descriptor, taken = _opened(file, wait)
    try:
        if taken is False:
            raise UserError(f"{key}={folder}: another process is running in this folder")
        try:
            if taken:
                yield
            else:
                with _owned(folder, key):
                    yield
        finally:
            if folder.is_dir() and [each.name for each in folder.iterdir()] == [file.name]:
                file.unlink()
    finally:
        os.close(descriptor)


def _opened(file: Path, wait: float) -> tuple[int, bool | None]:
    """The descriptor of the lock, and what `_take` says of it."""
    until = time.monotonic() + wait
    while True:
        # Never emptied or replaced while in use: flock belongs to the open file, and a new file of the same name would
        # have a lock of its own.
        descriptor = reopen(file, "r+")
        taken = _take(descriptor, file)
        if taken is not False or time.monotonic() >= until:
            return descriptor, taken
        # Opened anew, since its owner may have removed the file: ours would then be one without a name.
        os.close(descriptor)


def is_locked(folder: Path) -> bool:
    """Whether a process is running in the folder, as far as its lock tells."""
    try:
        with opened(folder / _LOCK, most=2**20) as stream:
            # A shared lock, so that several who watch do not see each other as the owner; closing the file lets go of
            # it.
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError as error:
        return error.errno in UNSUPPORTED and _is_alive(folder / _OWNER)
    except UserError:
        return False
    return False


def _take(descriptor: int, file: Path) -> bool | None:
    """True if the lock was taken, False if another process holds it, None where the file system has no locks."""
    # More than once: `is_locked` of somebody who watches holds the file for an instant.
    for _ in range(_TRIES):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Between our opening the file and locking it, an owner that ended may have removed it: then this is a lock
            # on a file without a name, which nobody else will ever look at.
            return os.fstat(descriptor).st_ino == file.stat().st_ino  # not one that was just removed
        except OSError as error:
            if error.errno in UNSUPPORTED:
                return None
            if error.errno not in (errno.EAGAIN, errno.EACCES, errno.EINTR, errno.ENOENT):
                raise
            time.sleep(_BETWEEN)
    return False


@contextmanager
def _owned(folder: Path, key: str) -> Iterator[None]:
    """Lock the folder by a file that names its owner, and is touched every `_BEAT` seconds."""
    say_lacking(folder, "locks", f"{_OWNER} names the process that runs in it")
    file, token = folder / _OWNER, secrets.token_hex(8)
    if _is_alive(file):
        raise UserError(f"{key}={folder}: another process is running in this folder{_who(file)}")
    # Of two that both find a dead owner's file, each may remove the other's new one. So the one whose file is still
    # there a moment later has the folder.
    with suppress(FileExistsError), create(file) as stream:
        stream.write(json.dumps({"token": token, "host": socket.gethostname(), "pid": os.getpid()}).encode())
    time.sleep(_SETTLE)
    if known_object(file).get("token") != token:
        raise UserError(f"{key}={folder}: another process is running in this folder{_who(file)}")
    over = threading.Event()
    # A daemon thread: it must not keep a process alive whose main thread has ended.
    beat = threading.Thread(target=_beat, args=(file, over), daemon=True)
    beat.start()
    try:
        yield
    finally:
        over.set()
        beat.join()
        # Only our own: a host that was suspended for a minute may find that another has taken the folder over.
        if known_object(file).get("token") == token:
            file.unlink(missing_ok=True)


def _beat(file: Path, over: threading.Event) -> None:
    while not over.wait(_BEAT):
        with suppress(OSError):  # the folder may have been removed; the run finds that out by itself
            os.utime(file)


def _is_alive(file: Path) -> bool:
    """Whether the owner that the file names has given a sign of life.

    On this host the process is asked for. Elsewhere the file's age counts, by the clock of its own file system: that of
    this host may be off.
    """
    said = known_object(file)
    if not said:
        return False
    if said.get("host") == socket.gethostname() and isinstance(said.get("pid"), int):
        return _runs(said["pid"])
    # A new file shows the time by the clock that also stamps the owner's file, that of the file server.
    now = file.with_name(f"{_OWNER}.{secrets.token_hex(4)}")
    try:
        with create(now):
            return now.stat().st_mtime - file.stat().st_mtime < _SILENT
    except OSError:
        return True  # a folder that cannot be written to: better refused than shared
    finally:
        now.unlink(missing_ok=True)


def _runs(pid: int) -> bool:
    try:
        # Signal 0 is not sent; the call only says whether there is such a process. PermissionError: there is, another
        # user's.
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True


def _who(file: Path) -> str:
    said = known_object(file)
    return f" (process {said.get('pid')} on {said.get('host')})" if said else ""
