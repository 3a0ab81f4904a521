"""Checkpoints: one file each, whole or absent, with a hash over its bytes; tensors and plain values only.

A file is the output of `torch.save`, and then one line of fixed length: the format, and the SHA-256 of all before it.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import Any, BinaryIO

import torch

from trackmdp.durable import own_folder, remove_parts, second_name, sync_folder, whole_file
from trackmdp.errors import UserError
from trackmdp.untrusted import decoded, load_tensors, opened

CHECKPOINT_FORMAT = 9
BEST, LAST = "best.pt", "last.pt"
_SEAL = 128
_LARGEST = 2**38


def save(
    folder: Path, iteration: int, state: dict[str, Any], *, keep: int, best: bool = False
) -> Path:
    """Write `folder`/iteration-N.pt, point last.pt (and best.pt) to it, and remove all but the newest `keep`.

    The file appears under its name only once its bytes are on the disk; a failure leaves the older ones as they were.
    """
    own_folder(folder)
    remove_parts(folder)
    file = named(folder, iteration)
    # Three steps, and the process may be killed between any two: the new file (whole or absent), the names last.pt and
    # best.pt (put right by the run that resumes), the removal of old files (done by the next saving).
    with whole_file(file) as stream:
        try:
            torch.save({"iteration": iteration, **state}, stream)
        except RuntimeError as error:  # torch hides the reason of a failed write in it
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
        stream.seek(0)
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        # Zip readers look for their directory backwards from the end of the file, and 128 bytes more do not hide it.
        stream.write(_seal(digest))
    point(file, best=best)
    for old in available_checkpoints(folder)[keep:]:
        # best.pt may be another name of this file: the bytes then stay, under that name.
        old.unlink()
    return file


def named(folder: Path, iteration: int) -> Path:
    """The file of a checkpoint."""
    return folder / f"iteration-{iteration:08d}.pt"


def point(file: Path, *, best: bool) -> None:
    """Let last.pt, and best.pt too if `best`, be this checkpoint; a run that resumes calls it as well."""
    remove_parts(file.parent)
    for name in (LAST, BEST) if best else (LAST,):
        second_name(file, file.with_name(name))
    sync_folder(file.parent)


def available_checkpoints(folder: Path) -> list[Path]:
    """The ordinary files among the checkpoints in a run's folder of checkpoints, the newest first."""
    found = folder.glob(f"iteration-{'[0-9]' * 8}.pt")
    # By name, which is by number: the names have eight digits each.
    return sorted(
        (file for file in found if file.is_file() and not file.is_symlink()), reverse=True
    )


def remove_later(folder: Path, iteration: int) -> None:
    """Remove the checkpoints after `iteration`, of a course of the run that was left; the newest first.

    Before the logs are cut back to `iteration`: a run that is killed in between then resumes from where they end.
    """
    own_folder(folder)
    later = [file for file in available_checkpoints(folder) if file > named(folder, iteration)]
    for file in later:
        file.unlink()
    if later:
        sync_folder(folder)


def newest(run: Path, key: str = "run") -> Path:
    """The newest checkpoint of a run folder, which the option `key` names.

    Raises:
        UserError: there is no such folder, or no checkpoint in it.
    """
    if not run.is_dir():
        raise UserError(f"{key}={run}: no such folder")
    files = available_checkpoints(run / "checkpoints")
    if not files:
        raise UserError(
            f"{key}={run}: no checkpoint in {run / 'checkpoints'}; the run has not saved one yet"
        )
    return files[0]


def load(file: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; its bytes are checked before they are decoded, and no code in it is ever run.

    Raises:
        UserError: the file is missing, damaged, foreign, or of another format.
    """
    with opened(file, most=_LARGEST) as stream, decoded(str(file), "a checkpoint that can be read"):
        _check(file, stream)
        return dict(load_tensors(file, device))


def _seal(digest: str) -> bytes:
    return (
        f"\ntrackmdp checkpoint {CHECKPOINT_FORMAT} sha256 {digest}".encode().ljust(_SEAL - 1)
        + b"\n"
    )


def _check(file: Path, stream: BinaryIO) -> None:
    """Compare the hash of a file with the one in its seal.

    Raises:
        UserError: they differ, or the seal is missing or of another format.
    """
    # The last 128 bytes: a newline, `trackmdp checkpoint N sha256 ` and 64 hexadecimal digits, blanks, a newline.
    left = max(stream.seek(0, os.SEEK_END) - _SEAL, 0)
    stream.seek(left)
    found = re.fullmatch(rb"\ntrackmdp checkpoint (\d+) sha256 ([0-9a-f]{64}) *\n", stream.read())
    if found is None:
        raise UserError(f"{file}: damaged, or not a checkpoint of this program")
    if int(found[1]) != CHECKPOINT_FORMAT:
        raise UserError(f"{file}: checkpoint format {int(found[1])}, expected {CHECKPOINT_FORMAT}")
    stream.seek(0)
    digest = hashlib.sha256()
    while left:
        piece = stream.read(min(left, 2**20))
        digest.update(piece)
        left -= len(piece)
    if digest.hexdigest() != found[2].decode():
        raise UserError(f"{file}: damaged, its content does not match its hash")
