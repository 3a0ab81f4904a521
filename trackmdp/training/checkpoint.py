"""Checkpoints: one file each, whole or absent, with a hash over its bytes; tensors and plain values only.

A file is what `torch.save` writes, and then one line of fixed length: the format, and the SHA-256 of all before it.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import stat
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch

from trackmdp.durable import own_folder, second_name, sync_folder, whole_file
from trackmdp.errors import UserError
from trackmdp.untrusted import decoded, opened

CHECKPOINT_FORMAT = 5
BEST, LAST = "best.pt", "last.pt"
_SEAL = 128
_SMALL, _LARGEST = 2**20, 2**38
_NAME = re.compile(r"iteration-\d{8}\.pt")


def save(folder: Path, iteration: int, state: dict[str, Any], *, keep: int, best: bool = False) -> Path:
    """Write `folder`/iteration-N.pt, point last.pt (and best.pt) to it, and remove all but the newest `keep`.

    The file appears under its name only once its bytes are on the disk; a failure leaves the older ones as they were.
    """
    own_folder(folder)
    for left in folder.glob("*.part"):  # of a process that was killed while it saved
        left.unlink()
    file = named(folder, iteration)
    # Three steps, and the process may be killed between any two: the new file (whole or absent), the names last.pt and
    # best.pt (put right by the run that resumes), the removal of old files (done by the next saving).
    with whole_file(file) as stream:
        try:
            torch.save({"format": CHECKPOINT_FORMAT, "iteration": iteration, **state}, stream)
        except RuntimeError as error:  # what torch says when a write failed, whatever the reason
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
    """Let last.pt, and best.pt too if `best`, be this checkpoint.

    A run that resumes from `file` calls it as well: the process that wrote it may have been killed just before.
    """
    for name in (LAST, BEST) if best else (LAST,):
        second_name(file, file.with_name(name))
    sync_folder(file.parent)


def available_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints in a run's folder of checkpoints, the newest first.

    What is no ordinary file is somebody else's, not to be read or removed.
    """
    found = [file for file in folder.glob("iteration-*.pt") if _NAME.fullmatch(file.name)]
    # By name, which is by number, since the names have eight digits each. lstat: a link is not followed.
    return sorted((file for file in found if stat.S_ISREG(file.lstat().st_mode)), reverse=True)


def newest(run: Path) -> Path:
    """The newest checkpoint of a run folder.

    Raises:
        UserError: the run has none.
    """
    files = available_checkpoints(run / "checkpoints")
    if not files:
        raise UserError(f"run={run}: no checkpoint in {run / 'checkpoints'}; the run has not saved one yet")
    return files[0]


def load(file: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint; its bytes are checked before they are decoded, and no code in it is ever run.

    On the CPU its tensors are pages of the file, read once they are needed: a large buffer is not held twice.

    Raises:
        UserError: the file is missing, damaged, foreign, or of another format.
    """
    with opened(file, most=_LARGEST) as stream, decoded(str(file), "a checkpoint that can be read"):
        stored = _check_archive(stream, _check(file, stream))
        try:
            # weights_only: the unpickler builds tensors and plain containers and calls nothing else. mmap needs a
            # file's name.
            state = torch.load(str(file), map_location=device, mmap=True, weights_only=True)
        except pickle.UnpicklingError as error:  # torch advises to switch weights_only off
            raise ValueError("it holds more than tensors and plain values") from error
        # type(...): `True == 1`, and a tensor compared with 4 would give a tensor.
        if not isinstance(state, dict) or type(state.get("format")) is not int or state["format"] != CHECKPOINT_FORMAT:
            raise UserError(f"{file}: not the state of a run")
        # A tensor whose size goes beyond its own member of the archive would show the bytes that follow in the file.
        if _stored(_tensors(state)) != stored:
            raise ValueError("tensors that reach beyond what is stored of them")
        # The small ones are copied out of the file's pages, so that at most a large one keeps the file open.
        for tensor in _tensors(state):
            if tensor.nbytes <= _SMALL:
                # `.data`, so that the tensor object in its place in the nested state is changed, not a copy of it.
                tensor.data = tensor.clone()
    return state


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    """The tensors of a nested state."""
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, (Mapping, list, tuple)):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _tensors(part)


def _stored(tensors: Iterable[torch.Tensor]) -> int:
    """Bytes of all storages; as pages of a file, torch takes the length that a tensor claims for its own."""
    sizes: dict[int, int] = {}
    for tensor in tensors:
        # Copied into a real weight, its imaginary part would be lost with no more than a warning.
        if tensor.is_complex():
            raise ValueError("complex numbers")
        storage = tensor.untyped_storage()
        # By address, since tensors may share a storage (views); an empty storage has no address of its own.
        if storage.nbytes():
            sizes[storage.data_ptr()] = storage.nbytes()
    return sum(sizes.values())


def _seal(digest: str) -> bytes:
    return f"\ntrackmdp checkpoint {CHECKPOINT_FORMAT} sha256 {digest}".encode().ljust(_SEAL - 1) + b"\n"


def _check(file: Path, stream: BinaryIO) -> int:
    """The bytes before the seal, once their hash is the one that it names."""
    # The last 128 bytes: a newline, `trackmdp checkpoint N sha256 ` and 64 hexadecimal digits, blanks, a newline.
    size = left = max(stream.seek(0, os.SEEK_END) - _SEAL, 0)
    stream.seek(size)
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
    return size


def _check_archive(stream: BinaryIO, size: int) -> int:
    """See that the archive holds no more than its own bytes: `torch.load` would unfold a deflated one of any size.

    Returns the bytes of all tensors stored in it.
    """
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        # Where a file says that the bytes of its numbers are in another order, torch turns every number round. None of
        # ours says so: the machines that this program runs on have one order.
        order = next((each for each in members if each.filename.endswith("/byteorder")), None)
        if order is None or order.file_size > _SEAL or archive.read(order).decode() != sys.byteorder:
            raise ValueError("numbers in another order of bytes than this machine's")
    # torch.save stores, so that a deflated member is not its work; unpacked it might fill the memory.
    if any(member.compress_type != zipfile.ZIP_STORED for member in members):
        raise ValueError("a compressed archive")
    if sum(member.file_size for member in members) > size:
        raise ValueError("an archive that claims more bytes than it has")
    # The archive's members: NAME/data.pkl (the structure), NAME/data/0, NAME/data/1, ... (one for each storage), and a
    # few bytes of version and byte order.
    return sum(member.file_size for member in members if re.search(r"/data/[0-9]+$", member.filename))
