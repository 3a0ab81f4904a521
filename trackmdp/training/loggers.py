"""The loggers of training: `metrics.csv`, TensorBoard events, Weights & Biases, and MLflow."""

from __future__ import annotations

import csv
import math
import os
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from trackmdp.config import CsvConfig, MlflowConfig, TrainConfig, WandbConfig, to_dict, to_yaml
from trackmdp.config.loggers import RowsConfig
from trackmdp.config.registry import maker
from trackmdp.config.tree import flatten
from trackmdp.durable import own_folder, reopen, sync
from trackmdp.errors import Preempted, RunError
from trackmdp.training.callbacks import Callback, Row, Training
from trackmdp.training.evaluator import figures
from trackmdp.untrusted import decoded, opened


def make_loggers(cfg: TrainConfig, folder: Path) -> list[Callback]:
    """What the run writes of itself while it learns, each made by what its choice names."""
    # metrics.csv is written whatever the log is: reports and `Run.metrics` read it. `csv` stays first, with the options
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


class CsvLogger(RowLogger):
    """`metrics.csv`: one row per logged iteration; the columns are those of the first row.

    A value that is not there, or not finite, leaves its field empty. Numbers read back exactly.
    """

    name = "csv"
    _position = 0  # bytes that an earlier process left

    def on_start(self, trainer: Training) -> None:  # noqa: ARG002
        """Open the file; what an earlier process wrote after its last checkpoint is cut off.

        Raises:
            UserError: the file is a link, or not the one that the earlier process left.
        """
        self._path = self._folder / "metrics.csv"
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


class TensorboardLogger(RowLogger):
    """TensorBoard event files in `tensorboard/`, the same figures over frames."""

    name = "tensorboard"

    def on_start(self, trainer: Training) -> None:
        """Open a file; an earlier process's events after its last checkpoint are hidden."""
        from torch.utils.tensorboard import SummaryWriter  # optional dependency, a second to import

        folder, frames = self._folder / "tensorboard", trainer.position.frames
        own_folder(folder)
        # TensorBoard reads all event files of a folder together and cannot be told to drop a part of one; a
        # new file with purge_step hides the events of that step and later ones.
        self._events = SummaryWriter(folder, purge_step=frames + 1 if frames else None)
        self._events.add_text("config", f"```yaml\n{to_yaml(trainer.config)}\n```", frames)

    def write(self, row: Row) -> None:
        """Add the figures of `row`."""
        for key, value in known(row).items():
            self._events.add_scalar(key, value, row["frames"])

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


class _Tracker(RowLogger):
    """Logs to a run that has an id of its own, under which a resumed one goes on."""

    _id = ""  # until the run is begun

    def state_dict(self) -> dict[str, Any]:
        """The id of the run."""
        return {"id": self._id}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the run of that id."""
        self._id = str(state["id"])


class WandbLogger(_Tracker):
    """Weights & Biases through TorchRL's logger: config, a row per logged iteration over frames, final figures.

    A resumed run goes on under the same id. Offline each process leaves a folder `wandb/offline-run-*` of its own;
    `wandb sync` puts them together.
    """

    name = "wandb"
    _cfg: WandbConfig

    def on_start(self, trainer: Training) -> None:
        """Begin the run, or go on with it.

        Raises:
            RunError: the server cannot be reached, or nobody is logged in.
        """
        if self._cfg.mode == "offline":
            # Reports of wandb's own faults would go out over the network all the same.
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb
        from torchrl.record.loggers.wandb import WandbLogger as TorchrlLogger

        own_folder(self._folder / "wandb")
        self._id = self._id or secrets.token_hex(4)
        # No console capture, machine statistics or code: what is logged is the run's figures.
        quiet: dict[str, Any] = dict.fromkeys(("silent", "x_disable_stats", "disable_code", "disable_git"), True)
        quiet |= {"console": "off", "x_save_requirements": False}
        with _answering("wandb"):
            self._logger = TorchrlLogger(
                self._folder.resolve().name,
                save_dir=self._folder,
                id=self._id,
                project=self._cfg.project,
                # TorchRL's own `offline` would set WANDB_MODE for the whole process.
                mode=self._cfg.mode,
                log_env_packages=False,
                config=to_dict(trainer.config),
                settings=wandb.Settings(**quiet),
            )

    def write(self, row: Row) -> None:
        """Log the row."""
        self._logger.log_metrics(known(row), step=row["frames"], override_global_step=True)

    def on_end(self, trainer: Training) -> None:
        """Leave the final figures in the run's summary, and close it."""
        self._logger.experiment.summary.update(final_figures(trainer))
        self._logger.experiment.finish(exit_code=0 if trainer.error is None else 1)


class MlflowLogger(_Tracker):
    """MLflow: the options as parameters, a row per logged iteration over frames, final figures.

    By MLflow's client itself, for TorchRL's logger always begins another run. A resumed run goes on with the same one;
    rows that an earlier process logged after its last checkpoint are not logged twice.
    """

    name = "mlflow"
    _cfg: MlflowConfig
    _logged = -1  # frames of the last row that is there

    def on_start(self, trainer: Training) -> None:
        """Begin the run, or go on with it.

        Raises:
            RunError: the server or the database cannot be reached.
            UserError: the database of the run's folder is a link, or no ordinary file.
        """
        if self._cfg.uri is None:
            # SQLite would follow a link out of the folder; an empty file is a new database to it.
            os.close(reopen(self._folder / "mlflow.db", "r+"))
            # Reports of how mlflow is used would go out over the network from a run that is to stay here.
            os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        # Its database tells on standard error what tables it makes.
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "WARNING")
        from mlflow import MlflowClient

        uri = self._cfg.uri or f"sqlite:///{self._folder.resolve() / 'mlflow.db'}"
        with _answering("mlflow"):
            self._client = MlflowClient(uri)
            if not self._id:
                self._begin(trainer)
            else:
                self._client.update_run(self._id, status="RUNNING")
                rows = self._client.get_metric_history(self._id, "frames")
                self._logged = max((row.step for row in rows), default=-1)

    def _begin(self, trainer: Training) -> None:
        from mlflow.entities import Param

        found = self._client.get_experiment_by_name(self._cfg.experiment)
        # Where artifacts would lie must be said: the default is a folder where the command was typed.
        place = (self._folder.resolve() / "mlflow").as_uri() if self._cfg.uri is None else None
        number = found.experiment_id if found else self._client.create_experiment(self._cfg.experiment, place)
        run = self._client.create_run(number, run_name=self._folder.resolve().name)
        self._id = run.info.run_id
        options = [Param(key, str(value)) for key, value in flatten(to_dict(trainer.config)).items()]
        for begin in range(0, len(options), 100):  # no more are taken at a time
            self._client.log_batch(self._id, params=options[begin : begin + 100])

    def write(self, row: Row) -> None:
        """Log the row, unless it is there."""
        measured = known(row)
        if measured["frames"] > self._logged:
            self._log(measured, int(measured["frames"]))

    def _log(self, row: Mapping[str, float], frames: int) -> None:
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        with _answering("mlflow"):
            self._client.log_batch(self._id, metrics=[Metric(key, value, now, frames) for key, value in row.items()])

    def on_end(self, trainer: Training) -> None:
        """Log the final figures, and how the run ended."""
        error = trainer.error
        if final := final_figures(trainer):
            self._log(final, trainer.position.frames)
        ended = "FINISHED" if error is None else "KILLED" if isinstance(error, Preempted) else "FAILED"
        self._client.set_terminated(self._id, ended)


@contextmanager
def _answering(name: str) -> Iterator[None]:
    """One line where a logger cannot do its work; the run can be resumed."""
    try:
        yield
    except Exception as error:  # whatever the package, its network or its database raises
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RunError(f"log=[{name}]: {reason}") from error
