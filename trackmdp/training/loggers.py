"""The loggers of training, and `metrics.csv`, which each run writes."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trackmdp.config import CsvConfig, TrainConfig
from trackmdp.config.logs import RowsConfig
from trackmdp.config.registry import maker
from trackmdp.durable import reopen, sync
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.untrusted import decoded, opened


def make_loggers(cfg: TrainConfig, folder: Path) -> list[Callback]:
    """The loggers of a run, each made by the maker of its choice."""
    # metrics.csv is written beside every log: reports and `Run.columns` read it. `csv` stays first, with the options
    # of its own where it is chosen.
    chosen = {"csv": CsvConfig(every=1)} | cfg.log
    # Each is imported by the name in its schema, since the packages it may need (mcap) are not to load without it.
    return [maker(node)(node, folder) for node in chosen.values()]


class RowLogger(Callback):
    """Writes the rows of the iterations that are due.

    Args:
        cfg: how often, and where to.
        folder: of the run.
    """

    def __init__(self, cfg: RowsConfig, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder

    def on_update(self, trainer: Training, row: Row) -> None:
        """Write the row where it is due."""
        if trainer.due(self._cfg.every):
            self.write(row)

    def write(self, row: Row) -> None:
        """Append `row`."""
        raise NotImplementedError


class CsvLogger(RowLogger):
    """`metrics.csv`: one row per logged iteration; the columns are those of the first row.

    A value that is not there, or not finite, leaves its field empty. Numbers read back exactly.
    """

    name = "csv"
    _position = 0  # bytes that an earlier process left
    _columns: Sequence[str] = ()  # of its head

    def on_start(self, trainer: Training) -> None:  # noqa: ARG002
        """Open the file; rows of an earlier process after its last checkpoint are cut off.

        Raises:
            UserError: the file is a link, or not the one that the earlier process left.
        """
        self._path = self._folder / "metrics.csv"
        if self._position:
            source = str(self._path)
            with opened(self._path, most=2**36) as stream, decoded(source, "this run's metrics"):
                names = next(csv.reader([stream.readline(2**16).decode()], strict=True))
                stream.seek(self._position - 1)
                # A file system without fsync may have lost the last rows; or the file was changed meanwhile, and cut at
                # this byte it would end in half a row.
                if names != self._columns or stream.read(1) != b"\n":
                    at = f"{self._position:,}, where the checkpoint was saved"
                    raise ValueError(f"expected its own columns, and the end of a row at byte {at}")
        descriptor = reopen(self._path, empty=not self._position)
        self._file = os.fdopen(descriptor, "r+", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, self._columns)
        # Rows after the checkpoint are of iterations that are run again: left in place they would stand there twice.
        self._file.truncate(self._position)
        self._file.seek(0, os.SEEK_END)

    def write(self, row: Row) -> None:
        """Append `row`; it is on its way to the disk at once."""
        if not self._writer.fieldnames:
            self._writer.fieldnames = list(row)
            self._writer.writeheader()
        self._writer.writerow(known(row))
        # Flushed to the operating system, not synced: after a kill the rows are there, and others can watch
        # them grow; fsync for each row would cost more than some iterations.
        self._file.flush()

    def on_end(self, trainer: Training) -> None:  # noqa: ARG002
        """Close the file."""
        self._file.close()

    def state_dict(self) -> dict[str, Any]:
        """Bytes of the file so far, which are on the disk from then on.

        The checkpoint that holds this number is: after a power failure it must not find fewer bytes.
        """
        sync(self._file, self._path)
        return {"position": self._file.tell(), "columns": list(self._writer.fieldnames)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume the file at the length it had when the state was taken."""
        self._position, self._columns = state["position"], state["columns"]


def known(row: Row) -> dict[str, float | int]:
    """The measurements that are finite numbers."""
    return {key: value for key, value in row.items() if value is not None and math.isfinite(value)}
