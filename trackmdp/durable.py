"""Atomic writes: a file is whole or absent, whatever happens meanwhile, and a link is never followed out of its folder.

Some file systems lack a call; the user is then told once. Without hard links (exFAT, many network and FUSE mounts) a
copy is made. Without `fsync` a power failure may cost what was saved last, never what was saved before.
"""

from __future__ import annotations

import csv
import errno
import fcntl
import io
import json
import math
import os
import shutil
import stat
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedRandom
from pathlib import Path
from typing import IO, Any

from trackmdp.errors import UserError
from trackmdp.untrusted import printable, sealed

UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK)
"""What a file system answers to a call that it does not know. EIO and ENOSPC are failures, and stay so."""

_NO_LINKS = (*UNSUPPORTED, errno.EPERM, errno.EXDEV, errno.EMLINK)
_said: set[str] = set()
_TRIES, _BETWEEN = 1200, 0.05
"""A minute: more than a file takes that two processes happen to write at once."""


@contextmanager
def whole_file(file: Path) -> Iterator[BufferedRandom]:
    """Write to `file`, which appears under its name only once its bytes are on the disk; a failure leaves no trace.

    Processes that write it at once take turns, and the last one's is kept.

    Where `file` is a symbolic link, the link is replaced, and what it leads to stays as it is.
    """
    # In the same folder, since a rename is atomic within one file system only.
    part = file.with_name(f"{file.name}.part")
    with _begin(part) as stream:
        try:
            yield stream
            sync(stream, part)
            # After the sync: a rename may reach the disk before the bytes do, and a power failure would leave an empty
            # file under the final name. Before the closing, which lets go of the lock: the name is ours until then.
            part.replace(file)
        # Ctrl-C as well, which is no Exception.
        except BaseException:
            part.unlink(missing_ok=True)
            raise


def _begin(part: Path) -> BufferedRandom:
    """A new file, open and locked, so that of several processes one at a time writes it; a killed one's is removed.

    Raises:
        UserError: another process goes on writing it.
    """
    for _ in range(_TRIES):
        _remove_left(part)
        # FileExistsError: another process was faster.
        with suppress(FileExistsError):
            stream = _new(part)
            if _is_ours(stream.fileno(), part):
                return stream
            stream.close()
        time.sleep(_BETWEEN)
    raise UserError(f"{part}: another process is writing it")


def _remove_left(part: Path) -> None:
    """Remove what has this name, unless a process is writing it."""
    try:
        descriptor = os.open(part, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:  # nothing, or what is not ours, such as a link
        part.unlink(missing_ok=True)
        return
    try:
        if _is_ours(descriptor, part):
            part.unlink()
    finally:
        os.close(descriptor)


def _is_ours(descriptor: int, file: Path) -> bool:
    """Whether the open file is now locked and still has its name; true on a file system without locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Between our opening and locking it, another process may have removed it and begun one of its own.
        return os.path.samestat(os.fstat(descriptor), file.lstat())
    except OSError as error:
        if error.errno in UNSUPPORTED:
            return True
        if error.errno in (errno.EAGAIN, errno.EACCES, errno.ENOENT):
            return False
        raise


def create(file: Path) -> BufferedRandom:
    """A new file, open for writing and reading; whatever had its name, a link included, is removed, not followed."""
    file.unlink(missing_ok=True)
    return _new(file)


def _new(file: Path) -> BufferedRandom:
    # O_EXCL: if somebody puts a link under this name meanwhile, the call fails instead of writing where it leads.
    return os.fdopen(os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666), "w+b")


def reopen(file: Path, mode: str) -> int:
    """A descriptor of a file that is written in place, made if it is missing: `r+` keeps its content, `w` empties it.

    Raises:
        UserError: it is a symbolic link, which may lead out of the folder, or no ordinary file.
    """
    try:
        # No O_TRUNC: a device or a file that is not ours must be recognised before anything of it is lost.
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise UserError(f"{file}: a link, a folder or a device, expected an ordinary file") from None
        raise
    # Asked of the descriptor: the name may stand for another file by the time a second call looks at it.
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise UserError(f"{file}: a pipe or a device, expected an ordinary file")
    if mode == "w":
        os.ftruncate(descriptor, 0)
    return descriptor


def own_folder(folder: Path) -> None:
    """Make a folder inside that of a run, unless it is there.

    Raises:
        UserError: its name is that of a link or of a file: what is written to it, and what is cleared away in it, would
            be somebody else's.
    """
    if not folder.is_symlink():
        try:
            folder.mkdir(exist_ok=True)
            return
        except FileExistsError:
            pass
    raise UserError(f"{folder}: a link or a file, expected a folder of the run's own")


def second_name(file: Path, name: Path) -> None:
    """Give `file` another name as well, replacing what had it; where there are no hard links, by a copy."""
    part = name.with_suffix(".part")
    part.unlink(missing_ok=True)
    try:
        # os.link cannot replace a name, a rename can: link to a third name, then rename it over the old one. In this
        # order there is a whole `name` at every moment.
        os.link(file, part)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        say_lacking(file.parent, "hard links", "best.pt and last.pt are copies")
        with whole_file(name) as stream, file.open("rb") as source:
            shutil.copyfileobj(source, stream)
        return
    part.replace(name)
    part.unlink(missing_ok=True)  # rename does nothing where both are names of one file already


def sync(stream: IO[Any], file: Path) -> None:
    """Put the bytes written to `file` on the disk."""
    stream.flush()
    _fsync(stream.fileno(), file.parent)


def sync_folder(folder: Path) -> None:
    """Make renames in `folder` survive a power failure."""
    # A rename changes the folder, not the file: syncing the file alone does not keep its new name.
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        _fsync(descriptor, folder)
    finally:
        os.close(descriptor)


def _fsync(descriptor: int, folder: Path) -> None:
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in UNSUPPORTED:
            raise
        say_lacking(folder, "fsync", "a power failure may cost what was saved last")


def say_lacking(folder: Path, what: str, instead: str) -> None:
    """Tell the user, once, what the file system lacks, and what is done instead."""
    if what not in _said:
        _said.add(what)
        sys.stderr.write(printable(f"{folder}: the file system has no {what}; {instead}\n"))


def write_text(file: Path, text: str) -> None:
    """Write a file whole or not at all."""
    write_bytes(file, text.encode())


def csv_text(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table as CSV, its lines ended by a line feed."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([head, *rows])
    return stream.getvalue()


def write_bytes(file: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    with whole_file(file) as stream:
        stream.write(content)


def write_json(file: Path, content: Mapping[str, Any]) -> None:
    """Write JSON whole or not at all; a number that is not finite is written as null."""
    write_text(file, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def write_sealed(file: Path, content: Mapping[str, Any]) -> None:
    """Write JSON with a digest of itself, whole or not at all; see `untrusted.sealed`."""
    write_json(file, sealed(_finite(content)))


def _finite(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {str(key): _finite(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_finite(value) for value in content]
    # json.dumps writes NaN and Infinity, which are no JSON: a browser's JSON.parse refuses the whole file.
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
