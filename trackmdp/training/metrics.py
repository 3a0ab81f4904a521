"""The loggers of training: `metrics.csv` and TensorBoard events."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trackmdp.config import to_yaml
from trackmdp.config.loggers import RowsConfig
from trackmdp.durable import own_folder, reopen, sync
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.training.evaluator import figures
from trackmdp.untrusted import decoded, opened


class CsvLogger(Callback):
    """`metrics.csv`: one row per logged iteration; the columns are those of the first row.

    A value that is not there, or not finite, leaves its field empty. Numbers read back exactly.

    Args:
        cfg: how often.
        folder: of the run.
    """

    name = "csv"

    def __init__(self, cfg: RowsConfig, folder: Path) -> None:
        self._every, self._path, self._position = cfg.every, folder / "metrics.csv", 0

    def on_start(self, trainer: Training) -> None:  # noqa: ARG002
        """Open the file; what an earlier process wrote after its last checkpoint is cut off.

        Raises:
            UserError: the file is a link, or not the one that the earlier process left.
        """
        # The columns are read and checked before the file is opened for writing: a file that is refused
        # stays as it was.
        names = _names(self._path, self._position) if self._position else None
        mode = "r+" if self._position else "w"
        self._file = os.fdopen(reopen(self._path, mode), "r+", newline="", encoding="utf-8")
        self._writer: csv.DictWriter[str] | None = None
        if names is not None:
            self._writer = csv.DictWriter(self._file, fieldnames=names)
            # Rows after the checkpoint are of iterations that are run again: left in place they would
            # stand there twice.
            self._file.truncate(self._position)
            self._file.seek(0, os.SEEK_END)

    def on_update(self, trainer: Training, row: Row) -> None:
        """Write the row where it is due."""
        if trainer.due(self._every):
            self.write(row)

    def write(self, row: Row) -> None:
        """Append `row`; it is on its way to the disk at once."""
        if self._writer is None:
            self._writer = csv.DictWriter(self._file, fieldnames=list(row))
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
        return {"position": self._file.tell()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume the file at the length it had when the state was taken."""
        self._position = state["position"]


class TensorboardLogger(Callback):
    """TensorBoard event files in `tensorboard/`, the same figures over frames.

    Args:
        cfg: how often.
        folder: of the run.
    """

    name = "tensorboard"

    def __init__(self, cfg: RowsConfig, folder: Path) -> None:
        self._every, self._folder = cfg.every, folder / "tensorboard"

    def on_start(self, trainer: Training) -> None:
        """Open a file; an earlier process's events after its last checkpoint are hidden."""
        from torch.utils.tensorboard import SummaryWriter  # optional dependency, a second to import

        own_folder(self._folder)
        frames = trainer.position.frames
        # TensorBoard reads all event files of a folder together and cannot be told to drop a part of one; a
        # new file with purge_step hides the events of that step and later ones.
        self._events = SummaryWriter(self._folder, purge_step=frames + 1 if frames else None)
        self._events.add_text("config", f"```yaml\n{to_yaml(trainer.config)}\n```", frames)

    def on_update(self, trainer: Training, row: Row) -> None:
        """Write the row where it is due."""
        if trainer.due(self._every):
            for key, value in known(row).items():
                self._events.add_scalar(key, value, trainer.position.frames)

    def on_end(self, trainer: Training) -> None:
        """Write the final figures, and close the file."""
        for key, value in final_figures(trainer).items():
            self._events.add_scalar(key, value, trainer.position.frames)
        self._events.close()


def final_figures(trainer: Training) -> dict[str, float]:
    """`final/...`: the figures of the last policy and its regret, once all iterations are done; none before."""
    if trainer.error is not None:
        return {}
    score = trainer.score
    found = figures(score.evaluation) | {"regret_per_step": score.regret_per_step}
    return {f"final/{key}": value for key, value in known(found).items()}


def known(row: Row) -> dict[str, float | int]:
    """What was measured, and is a finite number."""
    return {key: value for key, value in row.items() if value is not None and math.isfinite(value)}


def _names(file: Path, position: int) -> list[str]:
    """The columns of a table whose first `position` bytes hold, read before anything in it is changed.

    Raises:
        UserError: those bytes are not there, or are no such table.
    """
    with opened(file, most=2**36) as stream, decoded(str(file), "the metrics of this run"):
        head = stream.readline(2**16)
        # Shorter than the checkpoint remembers, or without a row's end there: the file was changed or
        # replaced meanwhile, and truncating it at this byte would leave half a row.
        if stream.seek(0, os.SEEK_END) < position:
            raise ValueError(f"{stream.tell():,} bytes, the checkpoint was saved after {position:,}")
        stream.seek(position - 1)
        if stream.read(1) != b"\n":
            raise ValueError(f"no row ends at byte {position:,}, where the checkpoint was saved")
        names = next(csv.reader([head.decode("utf-8")], strict=True))
        if "frames" not in names or len(set(names)) < len(names):
            raise ValueError("its first line does not name the columns")
    return names
