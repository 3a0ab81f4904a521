"""Atomic writes: a file is whole or absent, also after a crash.

Some file systems lack a call, which is reported once. Without hard links (exFAT, many network and FUSE mounts) a copy
is made. Without `fsync` a power failure may cost the last save, never an earlier one.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import secrets
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import BufferedRandom
from pathlib import Path
from typing import IO, Any

from trackmdp.errors import UserError
from trackmdp.untrusted import printable, sealed

UNSUPPORTED = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.ENOLCK)
"""Answers of a file system to a call that it lacks. EIO and ENOSPC are failures."""

_NO_LINKS = (*UNSUPPORTED, errno.EPERM, errno.EXDEV, errno.EMLINK)
_reported: set[str] = set()


@contextmanager
def whole_file(file: Path) -> Iterator[BufferedRandom]:
    """Write to `file`, which appears under its name only once its bytes are on the disk; a failure leaves no trace.

    Where `file` is a symbolic link, the link is replaced, and its target stays as it is.
    """
    part = _part(file)
    if not file.parent.is_dir():  # else the message would name the hidden file
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(file.parent))
    with no_trace(part, file), create(part) as stream:
        yield stream
        # Before the renaming, which may reach the disk before the bytes do: a power failure would leave an empty file
        # under the final name.
        sync(stream, part)
        part.replace(file)


@contextmanager
def no_trace(part: Path, file: Path) -> Iterator[None]:
    """Remove `part` if `file`, which it is to become, cannot be written, and name that in the error."""
    try:
        yield
    # Ctrl-C included; outside of the `with`, which closes the stream and so tries once more to write what is left.
    except BaseException as error:
        part.unlink(missing_ok=True)
        # A full disk names no file.
        if isinstance(error, OSError) and error.errno and error.filename is None:
            error.filename = str(file)
        raise


def _part(file: Path) -> Path:
    """A new hidden name beside `file`; a rename is atomic within one file system only."""
    return file.with_name(f".{file.name}.{secrets.token_hex(4)}.part")


def remove_parts(folder: Path) -> None:
    """Remove the unfinished files of killed processes; the caller holds the lock of the folder's run."""
    for part in folder.glob(".*.part"):
        part.unlink(missing_ok=True)


def create(file: Path) -> BufferedRandom:
    """A new file, open for writing and reading, in place of the one of that name, or of a link."""
    file.unlink(missing_ok=True)
    return os.fdopen(os.open(file, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666), "w+b")


def reopen(file: Path, *, empty: bool = False) -> int:
    """A descriptor of a file that is written in place and made if it is missing.

    Raises:
        OSError: it is a folder, or a link, which may lead out of the folder.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | (os.O_TRUNC if empty else 0)
    return os.open(file, flags, 0o666)


def own_folder(folder: Path) -> None:
    """Make a folder inside a run's, unless it is there.

    Raises:
        UserError: its name belongs to a file, or to a link, which may lead out of the run's folder.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise UserError(f"{folder}: a link or a file, expected a folder of the run's own")
    folder.mkdir(exist_ok=True)


def second_name(file: Path, name: Path) -> None:
    """Give `file` another name as well, in place of the file of that name; without hard links, by a copy."""
    part = _part(name)
    try:
        # os.link cannot replace a name, a rename can: there is a whole `name` at every moment.
        os.link(file, part)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        report_lacking(file.parent, "hard links", "best.pt and last.pt are copies")
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
        report_lacking(folder, "fsync", "a power failure may cost the last save")


def report_lacking(folder: Path, call: str, instead: str) -> None:
    """Report once, in a line, that the file system lacks a call, and the replacement."""
    if call not in _reported:
        _reported.add(call)
        sys.stderr.write(printable(f"{folder}: the file system has no {call}; {instead}\n"))


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
