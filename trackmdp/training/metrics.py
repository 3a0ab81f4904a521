"""What a run writes of itself: `metrics.csv`, TensorBoard events, and JSON files that are whole or absent."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path

from trackmdp.durable import own_folder, reopen
from trackmdp.untrusted import decoded, opened

__all__ = ["MetricsLog"]


class MetricsLog:
    """One row per logged iteration; the columns are those of the first row.

    A value that is not there, or not finite, leaves its field empty. Numbers read back exactly.

    Args:
        folder: of the run.
        tensorboard: write event files as well.
        position: the `position` up to which the file of an earlier process holds; what follows is cut off.
        frames: those of the earlier process; its events after them are hidden.

    Raises:
        UserError: the file is a link, or not the one that the earlier process left.
    """

    def __init__(self, folder: Path, *, tensorboard: bool, position: int = 0, frames: int = 0) -> None:
        file = folder / "metrics.csv"
        names = _names(file, position) if position else None
        self._file = os.fdopen(reopen(file, "r+" if position else "w"), "r+", newline="", encoding="utf-8")
        self._writer: csv.DictWriter[str] | None = None
        if names is not None:
            self._writer = csv.DictWriter(self._file, fieldnames=names)
            self._file.truncate(position)
            self._file.seek(0, os.SEEK_END)
        self._events = None
        if tensorboard:
            from torch.utils.tensorboard import SummaryWriter  # optional dependency, a second to import

            own_folder(folder / "tensorboard")
            self._events = SummaryWriter(folder / "tensorboard", purge_step=frames + 1 if position else None)

    def write(self, row: Mapping[str, float | int | None]) -> None:
        """Append `row`; it must hold `frames`."""
        if self._writer is None:
            self._writer = csv.DictWriter(self._file, fieldnames=list(row))
            self._writer.writeheader()
        known = {key: value for key, value in row.items() if value is not None and math.isfinite(value)}
        self._writer.writerow(known)
        self._file.flush()
        if self._events is not None:
            for key, value in known.items():
                self._events.add_scalar(key, value, int(row["frames"] or 0))

    @property
    def position(self) -> int:
        """Bytes of `metrics.csv` so far."""
        return self._file.tell()

    def close(self) -> None:
        """End the files."""
        self._file.close()
        if self._events is not None:
            self._events.close()


def _names(file: Path, position: int) -> list[str]:
    """The columns of a table whose first `position` bytes hold, read before anything in it is changed.

    Raises:
        UserError: those bytes are not there, or are no such table.
    """
    with opened(file, most=2**36) as stream, decoded(str(file), "the metrics of this run"):
        head = stream.readline(2**16)
        if stream.seek(0, os.SEEK_END) < position:
            raise ValueError(f"{stream.tell():,} bytes, the checkpoint was saved after {position:,}")
        stream.seek(position - 1)
        if stream.read(1) != b"\n":
            raise ValueError(f"no row ends at byte {position:,}, where the checkpoint was saved")
        names = next(csv.reader([head.decode("utf-8")], strict=True))
        if "frames" not in names or len(set(names)) < len(names):
            raise ValueError("its first line does not name the columns")
    return names
