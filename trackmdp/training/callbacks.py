"""Callbacks of a training run, of which its logs, checkpoints and display are made; users may add their own.

Here are also the loggers of rows, and `metrics.csv`, which each run writes.
"""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from trackmdp.config import CsvConfig, TrainConfig
from trackmdp.config.logs import RowsConfig
from trackmdp.config.registry import maker
from trackmdp.durable import reopen, sync
from trackmdp.untrusted import decoded, opened

if TYPE_CHECKING:  # the display of a planner is no reason to load torch
    import torch
    from tensordict import TensorDictBase
    from torchrl.collectors import BaseCollector

    from trackmdp.algos.common import Algorithm
    from trackmdp.policies.policy import Policy
    from trackmdp.training.evaluator import Evaluator, Score
    from trackmdp.world.group import Subject

Row = Mapping[str, float | int | None]
"""Figures of one iteration by their names, as `metrics.csv` has them; None for missing figures."""


@dataclass(frozen=True)
class Position:
    """How far a run is: iterations done, frames collected, seconds spent, and the sum of the frames' rewards."""

    iteration: int = 0
    frames: int = 0
    seconds: float = 0.0
    reward: float = 0.0


class Learning:
    """A run that learns, of the whole grid or by blocks.

    Args:
        problem: the world, recorded tracks, or several targets. A learner is given its task alone.
        config: the checked config of `trackmdp train`.
        folder: of the run's files; None to write nothing.
        console: where progress is shown; None for nowhere.

    Attributes:
        evaluator: gives figures of policies, and upper bounds. From the start of `run` on.
        callbacks: called during the run.
        start: where an earlier process left the run.
        position: how far the run is.
    """

    evaluator: Evaluator

    def __init__(
        self, problem: Subject, config: TrainConfig, folder: Path | None, console: Console | None
    ) -> None:
        self.problem, self.config, self.folder = problem, config, folder
        self.console = console or Console(quiet=True)
        self.callbacks: list[Callback] = []
        self.start, self.position = Position(), Position()

    def run(self) -> Score:
        """Learn to the end; the score of the last policy."""
        raise NotImplementedError

    def policy(self) -> Policy:
        """The policy as it is now."""
        raise NotImplementedError


class Training(Learning):
    """The run as callbacks may read it: the trainer, `trackmdp.training.trainer.Trainer`, which describes each."""

    device: torch.device
    algorithm: Algorithm
    collector: BaseCollector
    collecting: float
    score: Score
    error: BaseException | None = None

    @property
    def iterations(self) -> int:
        """Iterations of the whole run."""
        return self.algorithm.iterations

    @property
    def evaluates(self) -> bool:
        """Whether the policy of this iteration is evaluated, so that `score` is its own."""
        return self.position.iteration == 1 or self.due(self.config.evaluation.every)

    def due(self, every: int) -> bool:
        """Whether this iteration is a multiple of `every`, or the last one."""
        return self.position.iteration == self.iterations or self.position.iteration % every == 0


class Callback:
    """Base of all callbacks: every hook does nothing.

    In an iteration the hooks are called in the order `on_batch` (learning follows), `on_evaluation` where an
    evaluation is due, `on_update`, `on_checkpoint` where one was saved. The callbacks are called in the order in which
    the trainer has them. A hook may read everything of the trainer; to change the run is at its own risk.
    """

    name = ""
    """Under this name the callback's state stands in a checkpoint; "" for a callback without state."""

    def on_start(self, trainer: Training) -> None:
        """Everything is built, and a resumed run put back where it was; the first batch comes next."""

    def on_batch(self, trainer: Training, batch: TensorDictBase) -> None:
        """A batch `[B, time]` was collected; it is learned from next."""

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:
        """The policy learned so far was evaluated."""

    def on_update(self, trainer: Training, row: Row) -> None:
        """An iteration is over: learned, evaluated where that was due, `trainer.position` moved on."""

    def on_checkpoint(self, trainer: Training, file: Path) -> None:
        """A checkpoint was saved."""

    def on_end(self, trainer: Training) -> None:
        """The run is over, however it ended: `trainer.error` is None where all iterations are done.

        Called in reverse order, once for every callback after its `on_start`.
        """

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain values that a resumed run hands to `load_state_dict`."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state_dict`; called before `on_start`."""


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

    def on_start(self, trainer: Training) -> None:  # noqa: ARG002
        """Open the file; rows of an earlier process after its last checkpoint are cut off.

        Raises:
            UserError: the file is a link, or not the one that the earlier process left.
        """
        self._path = self._folder / "metrics.csv"
        names: list[str] = []
        if self._position:
            source = str(self._path)
            with opened(self._path, most=2**36) as stream, decoded(source, "this run's metrics"):
                names = next(csv.reader([stream.readline(2**16).decode()], strict=True))
                stream.seek(self._position - 1)
                # A file system without fsync may have lost the last rows; or the file was changed meanwhile, and cut at
                # this byte it would end in half a row.
                if names[0] != "iteration" or stream.read(1) != b"\n":
                    at = f"{self._position:,}, where the checkpoint was saved"
                    raise ValueError(
                        f"expected a head of columns, and the end of a row at byte {at}"
                    )
        descriptor = reopen(self._path, empty=not self._position)
        self._file = os.fdopen(descriptor, "r+", newline="", encoding="utf-8")
        self._writer = csv.DictWriter(self._file, names)
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
        return {"position": self._file.tell()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume the file at the length it had when the state was taken."""
        self._position = state["position"]


def known(row: Row) -> dict[str, float | int]:
    """The measurements that are finite numbers."""
    return {key: value for key, value in row.items() if value is not None and math.isfinite(value)}
