"""Files of others: read within limits of size, never unpickled, and refused in one line that names the file.

`opened` opens a file; inside `decoded` every error of a parser becomes one line. All that this package reads from a
disk goes through these two.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from trackmdp.errors import UserError
from trackmdp.machine import free_bytes

if TYPE_CHECKING:  # both take a fifth of a second to import
    import numpy.typing as npt
    import torch

SMALL = 2**24
"""Bytes of the largest config, summary, index or table of metrics: 16 MiB."""

LARGE = 2**32
"""Bytes of the largest table of numbers, unpacked: 4 GiB."""

_COPIES = 2
"""Times that the bytes of an archive's arrays are in memory while it is read."""

_DEEPEST, _MOST_VALUES = 50, 2**20
"""Of a config. A value of two bytes takes 300 in memory, and seven microseconds."""


def opened(file: Path, *, most: int, source: str = "", links: bool = False) -> BufferedReader:
    """An ordinary file of at most `most` bytes, open for reading.

    Args:
        file: its name.
        most: bytes.
        source: its name in messages.
        links: whether it may be a symbolic link. True only where a user named this very file: a link in the folder of
            a run may lead out of that folder.

    Raises:
        UserError: it is missing, too long, or no ordinary file.
    """
    source = source or str(file)
    # O_NONBLOCK: to open a pipe without a writer would take for ever.
    more = os.O_NONBLOCK | (0 if links else os.O_NOFOLLOW)
    try:
        stream = open(file, "rb", opener=lambda name, flags: os.open(name, flags | more))  # noqa: SIM115
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise UserError(f"{source}: {reason(error)}") from None
    found = os.fstat(stream.fileno())
    if stat.S_ISREG(found.st_mode) and found.st_size <= most:
        return stream
    stream.close()
    if not stat.S_ISREG(found.st_mode):
        raise UserError(f"{source}: a pipe or a device, expected an ordinary file")
    raise UserError(f"{source}: {found.st_size:,} bytes, expected at most {most:,}")


@contextmanager
def decoded(source: str, expected: str) -> Iterator[None]:
    """Any error inside becomes one line: `SOURCE: not EXPECTED (reason)`.

    Parsers raise more over damaged bytes than their documentation names: zlib.error, struct.error, RecursionError,
    MemoryError, KeyError, NotImplementedError.

    Raises:
        UserError: decoding failed.
    """
    try:
        yield
    except UserError as error:
        # A constructor names its argument; the file is named here.
        if str(error).startswith(source):
            raise
        raise UserError(f"{source}: {printable(str(error))}") from error
    except Exception as error:
        raise UserError(f"{source}: not {expected} ({reason(error)})") from error


def reason(error: BaseException) -> str:
    """The reason of an error in one short line."""
    if isinstance(error, OSError) and error.errno is not None:
        if error.errno == errno.ELOOP:
            return "a symbolic link, expected an ordinary file"
        return "no such file" if error.errno == errno.ENOENT else os.strerror(error.errno).lower()
    if isinstance(error, KeyError):
        return printable(f"no {error}")[:200]
    line = printable(" ".join(str(error).split()))
    return line[:200] or type(error).__name__


def read_bytes(file: Path, *, most: int = SMALL, links: bool = False) -> bytes:
    """The content of an ordinary file; see `opened`.

    Raises:
        UserError: it cannot be read.
    """
    with (
        opened(file, most=most, links=links) as stream,
        decoded(str(file), "a file that can be read"),
    ):
        # The present length: read(most) would allocate `most` bytes at once, and a file may be growing.
        return stream.read(os.fstat(stream.fileno()).st_size)


def read_text(file: Path, *, most: int = SMALL, links: bool = False) -> str:
    """The content of an ordinary file of UTF-8 text, without a byte order mark.

    Raises:
        UserError: it cannot be read, or is no such text.
    """
    content = read_bytes(file, most=most, links=links)
    with decoded(str(file), "UTF-8 text"):
        return content.decode("utf-8-sig")


def parse_json(text: str | bytes, source: str) -> Any:
    """The value of JSON text.

    Raises:
        UserError: it is something else.
    """
    with decoded(source, "JSON"):
        return json.loads(text, parse_constant=_refused)


def _refused(word: str) -> Any:
    raise ValueError(f"{word} is not JSON")


def read_object(file: Path, *, most: int = SMALL) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        UserError: it cannot be read, or is something else.
    """
    content = parse_json(read_text(file, most=most), str(file))
    if not isinstance(content, dict):
        raise UserError(f"{file}: expected a JSON object")
    return content


def known_object(file: Path, *, most: int = SMALL) -> dict[str, Any]:
    """The JSON object in a file of at most `most` bytes; empty where there is none."""
    try:
        return read_object(file, most=most)
    except UserError:
        return {}


def parse_yaml(text: str | bytes, source: str) -> dict[str, Any]:
    """The mapping in YAML text, of plain data.

    Raises:
        UserError: it is something else.
    """
    import yaml  # type: ignore[import-untyped]  # a dependency of OmegaConf; a fifth of the time of `--version`

    # libyaml is ten times faster, and not always there
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    with decoded(source, "a config"):
        depth = 0
        for number, event in enumerate(yaml.parse(text, Loader=loader)):
            depth += isinstance(event, yaml.CollectionStartEvent)
            depth -= isinstance(event, yaml.CollectionEndEvent)
            # Nine lists of nine aliases each, ten times over, are 9^10 values in 700 bytes.
            if isinstance(event, yaml.AliasEvent) or depth > _DEEPEST:
                raise ValueError(f"an alias, or deeper than {_DEEPEST} levels")
            if number > _MOST_VALUES:
                raise ValueError(f"more than {_MOST_VALUES:,} values")
        plain = yaml.load(text, Loader=loader)
        if not isinstance(plain, (dict, type(None))):
            raise ValueError("expected a mapping")
        return {str(key): value for key, value in (plain or {}).items()}


def load_npy(stream: BinaryIO) -> npt.NDArray[Any]:
    """The array of an `.npy` file; call it inside `decoded`.

    Raises:
        Exception: it is something else, or holds Python objects.
    """
    import numpy as np

    array: npt.NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    if stream.read(1):
        raise ValueError("more bytes than its header names")
    return array


def load_npz(stream: BinaryIO) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an `.npz` file by their names; call it inside `decoded`.

    Raises:
        Exception: it is something else, too large, or holds Python objects.
    """
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        # With a wrong bit in the length of a comment, the next entries of the directory are the text of it.
        if any(member.comment for member in members):
            raise ValueError("a comment in its directory")
        # A member never unpacks to more than the length in the archive's directory.
        _check_unpacked(sum(member.file_size for member in members))
        # Each member is read to its end, where zipfile compares the checksum. Not by its name: a wrong bit may make it
        # that of another one.
        arrays = {
            member.filename.removesuffix(".npy"): load_npy(io.BytesIO(archive.read(member)))
            for member in members
        }
    # Numbers of one byte become floats of eight where they are used.
    _check_unpacked(8 * sum(array.size for array in arrays.values()))
    return arrays


def _check_unpacked(size: int) -> None:
    if size > (most := min(LARGE, free_bytes() // _COPIES)):
        raise ValueError(f"{size:,} bytes when unpacked, expected at most {most:,}")


def load_tensors(file: Path, device: torch.device | str) -> Any:
    """The tensors and plain values that `torch.save` wrote; call it inside `decoded`.

    On the CPU the tensors are pages of the file, read when they are needed: a large buffer is not held twice.

    Raises:
        Exception: it is something else, compressed, or holds more than tensors and plain values.
    """
    import pickle

    import torch

    with zipfile.ZipFile(file) as archive:
        # torch.save does not compress; a compressed archive might fill the memory.
        if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
            raise ValueError("a compressed archive")
    try:
        return torch.load(str(file), map_location=device, mmap=True, weights_only=True)
    except pickle.UnpicklingError as error:  # torch advises to switch weights_only off
        raise ValueError("it holds more than tensors and plain values") from error


TIMED = re.compile("second|time|per_s$")
"""In the names of figures that the clock decides."""

# \x0b-\x1f: among others the carriage return, by which a name could overwrite its line, and escape; \x7f-\x9f: the C1
# controls; \u200e... and \u2066...: the direction of text; surrogates cannot be encoded, so that printing them raises.
_UNPRINTABLE = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


def no_formula(text: str) -> str:
    """The text of a cell that a spreadsheet shows and does not compute, also for hostile names of folders."""
    # After an apostrophe a spreadsheet takes a cell for text.
    return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text


def printable(text: str) -> str:
    r"""`text` with escapes such as \x1b for control characters, which a terminal would obey.

    Newlines and tabs stay.
    """
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """`content` with a digest of itself, by which a changed number in it is noticed.

    Times are left out of the digest: a run that is repeated has the same one. It is no signature: anybody can compute
    it anew.
    """
    return {**content, "sha256": _digest(content)}


def unsealed(content: Mapping[str, Any], source: str) -> dict[str, Any]:
    """`content` without its digest.

    Raises:
        UserError: it differs from the content that was sealed.
    """
    plain = {key: value for key, value in content.items() if key != "sha256"}
    with decoded(source, "a sealed object"):  # RecursionError: a thousand levels
        same = content.get("sha256") == _digest(plain)
    if not same:
        raise UserError(
            f"{source}: its content does not match its digest; it was changed, or is not by this program"
        )
    return plain


def _digest(content: Mapping[str, Any]) -> str:
    # Sorted keys: the digest must not depend on the order in which a dict was filled.
    return hashlib.sha256(json.dumps(_timeless(content), sort_keys=True).encode()).hexdigest()


def _timeless(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {
            str(key): _timeless(value)
            for key, value in content.items()
            if not TIMED.search(str(key))
        }
    return [_timeless(item) for item in content] if isinstance(content, (list, tuple)) else content
