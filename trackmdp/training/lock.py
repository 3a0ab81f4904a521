"""One process per run folder."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trackmdp.errors import UserError

__all__ = ["locked"]


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the run folder; the system lets go of it when the process ends, however it ends.

    Where nothing else was written, the lock's file is gone afterwards as well.

    Raises:
        UserError: another process holds it.
    """
    file = folder / ".lock"
    with file.open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.fstat(stream.fileno()).st_ino == file.stat().st_ino  # not one that was just removed
        except OSError:
            mine = False
        if not mine:
            raise UserError(f"hydra.run.dir={folder}: another process is running in this folder")
        try:
            yield
        finally:
            if folder.is_dir() and [each.name for each in folder.iterdir()] == [file.name]:
                file.unlink()
