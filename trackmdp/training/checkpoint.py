"""Checkpoints: one file each, whole or absent, with a hash over its bytes; tensors and plain values only.

A file is what `torch.save` writes, and then one line of fixed length: the format, and the SHA-256 of all before it.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import torch

from trackmdp.durable import sync_folder, whole_file
from trackmdp.errors import UserError

__all__ = ["BEST", "FORMAT", "LAST", "available", "load", "newest", "save"]

FORMAT = 3
BEST, LAST = "best.pt", "last.pt"
_SEAL = 128
_SMALL = 2**20
_NAME = re.compile(r"iteration-(\d+)\.pt")


def save(folder: Path, iteration: int, state: dict[str, Any], *, keep: int, best: bool = False) -> Path:
    """Write `folder`/iteration-N.pt, point last.pt (and best.pt) to it, and remove all but the newest `keep`.

    The file appears under its name only once its bytes are on the disk; a failure leaves the older ones as they were.
    """
    folder.mkdir(exist_ok=True)
    for left in folder.glob("*.part"):  # of a process that was killed while it saved
        left.unlink()
    file = folder / f"iteration-{iteration:08d}.pt"
    with whole_file(file) as stream:
        hashed = _Hashed(stream)
        hashed.save({"format": FORMAT, "iteration": iteration, **state})
        stream.write(_seal(hashed.digest.hexdigest()))
    for name in (LAST, BEST) if best else (LAST,):
        _link(file, folder / name)
    sync_folder(folder)
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

    On the CPU its tensors are pages of the file, read once they are needed: a large buffer is not held twice.

    Raises:
        UserError: the file is missing, damaged, foreign, or of another format.
    """
    try:
        with file.open("rb") as stream:
            _check(file, stream)
        state = torch.load(str(file), map_location=device, mmap=True, weights_only=True)
    except FileNotFoundError:
        raise UserError(f"{file}: no such file") from None
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{file}: a checkpoint that cannot be read ({type(error).__name__})") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise UserError(f"{file}: not the state of a run")
    _take_out(state)
    return state


def _take_out(value: Any) -> None:
    """Copy the small tensors out of the file's pages, so that at most a large one keeps the file open."""
    if isinstance(value, torch.Tensor):
        if value.nbytes <= _SMALL:
            value.data = value.clone()
    elif isinstance(value, (Mapping, list, tuple)):
        for part in value.values() if isinstance(value, Mapping) else value:
            _take_out(part)


class _Hashed:
    """A file that is only written to, front to back, and hashed on the way."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self.digest = stream, hashlib.sha256()
        self._failure: OSError | None = None

    def save(self, state: dict[str, Any]) -> None:
        try:
            torch.save(state, cast("IO[bytes]", self))
        except RuntimeError as error:  # what torch says when a write failed, whatever the reason
            raise self._failure or error from None

    def write(self, piece: bytes) -> int:
        self.digest.update(piece)
        try:
            return self._stream.write(piece)
        except OSError as error:
            self._failure = error
            raise

    def flush(self) -> None:
        self._stream.flush()


def _seal(digest: str) -> bytes:
    return f"\ntrackmdp checkpoint {FORMAT} sha256 {digest}".encode().ljust(_SEAL - 1) + b"\n"


def _check(file: Path, stream: BinaryIO) -> None:
    size = max(stream.seek(0, os.SEEK_END) - _SEAL, 0)
    stream.seek(size)
    found = re.fullmatch(rb"\ntrackmdp checkpoint (\d+) sha256 ([0-9a-f]{64}) *\n", stream.read())
    if found is None:
        raise UserError(f"{file}: damaged, or not a checkpoint of this program")
    if int(found[1]) != FORMAT:
        raise UserError(f"{file}: checkpoint format {int(found[1])}, expected {FORMAT}")
    stream.seek(0)
    digest = hashlib.sha256()
    while size:
        piece = stream.read(min(size, 2**20))
        digest.update(piece)
        size -= len(piece)
    if digest.hexdigest() != found[2].decode():
        raise UserError(f"{file}: damaged, its content does not match its hash")


def _numbered(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("iteration-*.pt") if _NAME.fullmatch(file.name))


def _link(file: Path, name: Path) -> None:
    """Give `file` a second name, replacing what had it."""
    part = name.with_suffix(".part")
    os.link(file, part)
    part.replace(name)
