"""One process per run folder."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from trackmdp.errors import UserError

__all__ = ["locked"]

_TRIES, _BETWEEN = 5, 0.05


@contextmanager
def locked(folder: Path, key: str = "hydra.run.dir") -> Iterator[None]:
    """Hold the folder that was chosen by `key`; the system lets go of it when the process ends, however it ends.

    Where nothing else was written, the lock's file is gone afterwards as well.

    Raises:
        UserError: another process holds it.
    """
    file = folder / ".lock"
    with file.open("w") as stream:
        if not _take(stream, file):
            raise UserError(f"{key}={folder}: another process is running in this folder")
        try:
            yield
        finally:
            if folder.is_dir() and [each.name for each in folder.iterdir()] == [file.name]:
                file.unlink()


def _take(stream: IO[str], file: Path) -> bool:
    """Whether the lock could be had; who only looks whether it is held does so for an instant."""
    for _ in range(_TRIES):
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return os.fstat(stream.fileno()).st_ino == file.stat().st_ino  # not one that was just removed
        except OSError:
            time.sleep(_BETWEEN)
    return False
