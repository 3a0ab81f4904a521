"""Files that others may have written, or that a power failure damaged: read within bounds, or refused in one line.

Every reader of a checkpoint, log, config, kernel, recording, result or summary opens it by `opened`, and decodes its
bytes inside `decoded`. Neither ever unpickles.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from trackmdp.errors import UserError

SMALL = 2**24
"""Bytes of the largest summary, plan, index or table of metrics: 16 MiB."""

_DEEPEST = 32
"""Levels of nested JSON. What this program writes has at most six; a recursive reader could follow a thousand."""

_LARGEST = 2**64
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def opened(file: Path, *, most: int, source: str = "", links: bool = False) -> BufferedReader:
    """An ordinary file of at most `most` bytes, open for reading.

    Args:
        file: its name.
        most: bytes; nothing is read of a longer one.
        source: what messages call it; its name by default.
        links: whether it may be a symbolic link. True only where a user named this very file: one found in the folder
            of a run may lead out of that folder.

    Raises:
        UserError: it is missing, too long, or no ordinary file.
    """
    source = source or str(file)
    # Without O_NONBLOCK, opening a pipe that nobody writes to would wait for ever.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if links else os.O_NOFOLLOW)
    try:
        descriptor = os.open(file, flags)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise UserError(f"{source}: {reason(error)}") from None
    try:
        # Of the open descriptor, not of the name, which may be exchanged between a check and the opening.
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            kind = _KINDS.get(stat.S_IFMT(found.st_mode), "something else")
            raise UserError(f"{source}: {kind}, expected an ordinary file")
        if found.st_size > most:
            raise UserError(f"{source}: {found.st_size:,} bytes, expected at most {most:,}")
    except BaseException:
        os.close(descriptor)
        raise
    return os.fdopen(descriptor, "rb")


@contextmanager
def decoded(source: str, expected: str) -> Iterator[None]:
    """Whatever decoding the content of `source` raises ends in one line: `SOURCE: not EXPECTED (reason)`.

    Every exception counts: over hostile bytes parsers raise what their documentation does not name (zlib.error,
    struct.error, RecursionError, MemoryError, KeyError, NotImplementedError for an odd compression).

    Raises:
        UserError: decoding failed.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{source}: not {expected} ({reason(error)})") from error


def reason(error: BaseException) -> str:
    """Why something failed, in one short line."""
    if isinstance(error, OSError) and error.errno is not None:
        if error.errno == errno.ELOOP:
            return "a symbolic link, expected an ordinary file"
        return "no such file" if error.errno == errno.ENOENT else os.strerror(error.errno).lower()
    said = printable(" ".join(str(error).split()))
    return said[:200] or type(error).__name__


def read_bytes(file: Path, *, most: int = SMALL, source: str = "", links: bool = False) -> bytes:
    """The content of an ordinary file; see `opened`.

    Raises:
        UserError: it cannot be read.
    """
    source = source or str(file)
    with opened(file, most=most, source=source, links=links) as stream, decoded(source, "a file that can be read"):
        # As long as it was a moment ago: read(most) would allocate that much at once, and a file may be growing.
        return stream.read(os.fstat(stream.fileno()).st_size)


def read_text(file: Path, *, most: int = SMALL, source: str = "", links: bool = False) -> str:
    """The content of an ordinary file of UTF-8 text, without a byte order mark.

    Raises:
        UserError: it cannot be read, or is no such text.
    """
    content = read_bytes(file, most=most, source=source, links=links)
    with decoded(source or str(file), "UTF-8 text"):
        return content.decode("utf-8-sig")


def read_object(file: Path, *, most: int = SMALL, source: str = "") -> dict[str, Any]:
    """The JSON object in a file; see `parse_json`.

    Raises:
        UserError: it cannot be read, or is something else.
    """
    content = parse_json(read_text(file, most=most, source=source), source or str(file))
    if not isinstance(content, dict):
        raise UserError(f"{source or file}: expected a JSON object")
    return content


def known_object(file: Path, *, most: int = SMALL) -> dict[str, Any]:
    """The JSON object in a file of at most `most` bytes; empty where there is none."""
    try:
        return read_object(file, most=most)
    except UserError:
        return {}


def parse_json(text: str | bytes, source: str) -> Any:
    """The value of JSON text: at most 32 levels deep, every number finite and an integer below 2^64 in size.

    Raises:
        UserError: it is something else.
    """
    with decoded(source, "JSON"):
        value = json.loads(text, parse_constant=_refused)
        level: list[Any] = [value]
        # Level by level instead of by recursion: json.loads follows more levels than Python's own stack holds.
        for _ in range(_DEEPEST):
            inner: list[Any] = []
            for item in level:
                if isinstance(item, (dict, list)):
                    inner += item.values() if isinstance(item, dict) else item
                elif isinstance(item, float) and not math.isfinite(item):  # 1e999
                    raise ValueError("a number that is not finite")
                elif isinstance(item, int) and abs(item) >= _LARGEST:
                    raise ValueError("an integer beyond 64 bits")
            if not inner:
                return value
            level = inner
        raise ValueError(f"deeper than {_DEEPEST} levels")


def _refused(word: str) -> Any:
    raise ValueError(f"{word} is not JSON")


_TIMED = re.compile("second|time|per_s$")
# \x0b-\x1f has the carriage return, by which a name could overwrite the line it stands in, and escape; \x7f-\x9f the
# C1 controls; \u200e... and \u2066... turn the direction of text; surrogates cannot be encoded, so that printing them
# raises.
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def no_formula(text: str) -> str:
    """The text of a cell that a spreadsheet shows and does not compute, whatever somebody called a folder."""
    # With an apostrophe before it, a spreadsheet takes it for text.
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def printable(text: str) -> str:
    r"""`text` with escapes such as \x1b for what a terminal would obey: control characters, and those that turn text.

    Newlines and tabs stay.
    """
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """`content` with a digest of itself, so that a changed number in it is noticed.

    What the clock decides is left out of the digest, so that a run repeated has the same one. It is no signature: who
    means to deceive can compute it anew.
    """
    return {**content, "sha256": _digest(content)}


def unsealed(content: Mapping[str, Any], source: str) -> dict[str, Any]:
    """`content` without its digest.

    Raises:
        UserError: it is not what was sealed.
    """
    plain = {key: value for key, value in content.items() if key != "sha256"}
    if content.get("sha256") != _digest(plain):
        raise UserError(f"{source}: its content does not match its digest; it was changed, or is not by this program")
    return plain


def _digest(content: Mapping[str, Any]) -> str:
    # Sorted keys: the digest must not depend on the order in which a dict was filled.
    return hashlib.sha256(json.dumps(_timeless(content), sort_keys=True).encode()).hexdigest()


def _timeless(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {str(key): _timeless(value) for key, value in content.items() if not _TIMED.search(str(key))}
    return [_timeless(item) for item in content] if isinstance(content, (list, tuple)) else content
