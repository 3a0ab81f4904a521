"""Checkpoints: one file each, whole or absent, with a hash over its bytes; tensors and plain values only.

A file is one line of fixed length, naming the format and the SHA-256 of the rest, and then what `torch.save` writes.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import torch

from trackmdp.errors import UserError

__all__ = ["BEST", "FORMAT", "LAST", "available", "load", "newest", "save"]

FORMAT = 2
BEST, LAST = "best.pt", "last.pt"
_HEADER = 128
_NAME = re.compile(r"iteration-(\d+)\.pt")


def save(folder: Path, iteration: int, state: dict[str, Any], *, keep: int, best: bool = False) -> Path:
    """Write `folder`/iteration-N.pt, point last.pt (and best.pt) to it, and remove all but the newest `keep`.

    The file appears under its name only once its bytes are on the disk; a failure leaves the older ones as they were.
    """
    folder.mkdir(exist_ok=True)
    file = folder / f"iteration-{iteration:08d}.pt"
    part = file.with_suffix(".part")
    try:
        with part.open("w+b") as stream:
            stream.write(_header("0" * 64))
            torch.save({"format": FORMAT, "iteration": iteration, **state}, stream)
            digest = _digest(stream)
            stream.seek(0)
            stream.write(_header(digest))
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(file)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    for name in (LAST, BEST) if best else (LAST,):
        _link(file, folder / name)
    _sync(folder)
    for old in _numbered(folder)[:-keep]:
        old.unlink()
    return file


def available(folder: Path) -> list[Path]:
    """The checkpoints in a run's folder of checkpoints, the newest first."""
    return _numbered(folder)[::-1]


def newest(run: Path) -> Path:
    """The newest checkpoint of a run folder.

    Raises:
        UserError: the run has none.
    """
    files = available(run / "checkpoints")
    if not files:
        raise UserError(f"run={run}: no checkpoint in {run / 'checkpoints'}; the run has not saved one yet")
    return files[0]


def load(file: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; its bytes are checked before they are decoded, and no code in it is ever run.

    Raises:
        UserError: the file is missing, damaged, foreign, or of another format.
    """
    try:
        with file.open("rb") as stream:
            _check(file, stream)
            state = torch.load(io.BufferedReader(_Payload(stream)), map_location=device, weights_only=True)
    except FileNotFoundError:
        raise UserError(f"{file}: no such file") from None
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{file}: a checkpoint that cannot be read ({type(error).__name__})") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise UserError(f"{file}: not the state of a run")
    return state


class _Payload(io.RawIOBase):
    """A file without its header, as a file of its own."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.seek(0)

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._stream.seek(offset + _HEADER if whence == os.SEEK_SET else offset, whence) - _HEADER

    def tell(self) -> int:
        return self._stream.tell() - _HEADER

    def readinto(self, buffer: Any) -> int:
        return self._stream.readinto(buffer)  # type: ignore[attr-defined]


def _header(digest: str) -> bytes:
    return f"trackmdp checkpoint {FORMAT} sha256 {digest}".encode().ljust(_HEADER - 1) + b"\n"


def _check(file: Path, stream: BinaryIO) -> None:
    found = re.fullmatch(rb"trackmdp checkpoint (\d+) sha256 ([0-9a-f]{64}) *\n", stream.read(_HEADER))
    if found is None:
        raise UserError(f"{file}: not a checkpoint of this program")
    if int(found[1]) != FORMAT:
        raise UserError(f"{file}: checkpoint format {int(found[1])}, expected {FORMAT}")
    if _digest(stream) != found[2].decode():
        raise UserError(f"{file}: damaged, its content does not match its hash")


def _digest(stream: BinaryIO) -> str:
    """SHA-256 of all that follows the header, in pieces, so that a large buffer is not held twice."""
    stream.seek(_HEADER)
    digest = hashlib.sha256()
    for piece in _pieces(stream):
        digest.update(piece)
    return digest.hexdigest()


def _pieces(stream: BinaryIO) -> Iterator[bytes]:
    while piece := stream.read(2**20):
        yield piece


def _numbered(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("iteration-*.pt") if _NAME.fullmatch(file.name))


def _link(file: Path, name: Path) -> None:
    """Give `file` a second name, replacing what had it."""
    part = name.with_suffix(".part")
    part.unlink(missing_ok=True)
    os.link(file, part)
    part.replace(name)


def _sync(folder: Path) -> None:
    """Make the renames themselves survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
