"""Loggers that end with the results of a run: TensorBoard, Weights & Biases, and MLflow."""

from __future__ import annotations

import os
import secrets
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from trackmdp.config import MlflowConfig, WandbConfig, to_dict, to_yaml
from trackmdp.config.tree import flatten
from trackmdp.durable import own_folder, reopen
from trackmdp.errors import Preempted, RunError
from trackmdp.notebook.drawing import drawn
from trackmdp.solvers.evaluation import figures
from trackmdp.training.callbacks import Row, Training
from trackmdp.training.loggers import RowLogger, known
from trackmdp.untrusted import reason
from trackmdp.world.group import Group


class FinalResults(NamedTuple):
    """The results of a run.

    Attributes:
        figures: the final ones.
        pictures: of PIL, by their names.
        policy: its file.
    """

    figures: dict[str, float]
    pictures: dict[str, Any]
    policy: Path


class ResultLogger(RowLogger):
    """Logs rows, and at the end of a whole run its figures, its pictures and its policy."""

    def on_end(self, trainer: Training) -> None:
        """Log the results, unless the run broke off, and close."""
        if trainer.error is None:
            pictures = {name: drawn(each) for name, each in pictures_of(trainer).items()}
            with tempfile.TemporaryDirectory() as folder:
                policy = Path(folder) / "policy.npz"
                trainer.policy().save(policy)
                score = trainer.score
                last = figures(score.evaluation) | {"regret_per_step": score.regret_per_step}
                final = {f"final/{key}": value for key, value in known(last).items()}
                self.results(FinalResults(final, pictures, policy), trainer)
        self.close(trainer.error)

    def results(self, found: FinalResults, trainer: Training) -> None:
        """Log the results."""
        raise NotImplementedError

    def close(self, error: BaseException | None) -> None:
        """End the log of a run, which ended by `error`."""
        raise NotImplementedError


def pictures_of(trainer: Training) -> dict[str, Any]:
    """Name -> picture of the policy, its values and some episodes; none where matplotlib is not installed."""
    if find_spec("matplotlib") is None:
        return {}
    from trackmdp.notebook.pictures import Heat, picture_of

    policy, problem = trainer.policy(), trainer.problem
    if isinstance(problem, Group):
        return {}
    found = {"policy": picture_of(policy), "world": picture_of(problem)}
    value = trainer.score.evaluation.value
    if value.shape == (problem.num_cells,) and np.isfinite(value).any():
        label = "V(x), reward per episode"
        found["value"] = Heat("value by start cell", value.reshape(problem.size), label)
    return {name: each for name, each in found.items() if each is not None}


def typed(trainer: Training) -> dict[str, str]:
    """All options of a run by their dotted names."""
    return {key: str(value) for key, value in flatten(to_dict(trainer.config)).items()}


class TensorboardLogger(ResultLogger):
    """TensorBoard event files in `tensorboard/`: figures over iterations, pictures, options, final figures.

    Not over frames: a learner that replays goes on after the last frame, and those rows would share one step.
    """

    name = "tensorboard"

    def on_start(self, trainer: Training) -> None:
        """Open a file; an earlier process's events after its last checkpoint are hidden."""
        from torch.utils.tensorboard import SummaryWriter  # optional dependency, a second to import

        folder, done = self._folder / "tensorboard", trainer.position.iteration
        own_folder(folder)
        # TensorBoard reads all event files of a folder together and cannot drop a part of one; a new file with
        # purge_step hides the events of that step and later ones.
        self._events = SummaryWriter(folder, purge_step=done + 1 if done else None)
        self._events.add_text("config", f"```yaml\n{to_yaml(trainer.config)}\n```", done)

    def write(self, row: Row) -> None:
        """Add the figures of `row`."""
        for key, value in known(row).items():
            self._events.add_scalar(key, value, row["iteration"])

    def results(self, found: FinalResults, trainer: Training) -> None:
        """Add pictures, the final figures, and for the view of hyperparameters the options."""
        last = trainer.position.iteration
        for name, picture in found.pictures.items():
            self._events.add_image(name, np.asarray(picture), last, dataformats="HWC")
        for key, value in found.figures.items():
            self._events.add_scalar(key, value, last)
        # In the same folder: by default a run of its own, named by the time, would appear beside this one.
        self._events.add_hparams(typed(trainer), found.figures, run_name=".", global_step=last)

    def close(self, error: BaseException | None) -> None:  # noqa: ARG002
        """Close the file."""
        self._events.close()


class _Tracker(ResultLogger):
    """Logs to a run that has an id of its own, under which a resumed one goes on."""

    _id = ""  # until the run is begun

    def state_dict(self) -> dict[str, Any]:
        """The id of the run."""
        return {"id": self._id}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the run of that id."""
        self._id = str(state["id"])


class WandbLogger(_Tracker):
    """Weights & Biases: config, a row per logged iteration over frames, final figures, pictures, the policy.

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

        own_folder(self._folder / "wandb")
        self._id = self._id or secrets.token_hex(4)
        # No console capture, machine statistics or code: only the run's figures are logged.
        quiet = wandb.Settings(
            silent=True,
            console="off",
            disable_code=True,
            disable_git=True,
            x_disable_stats=True,
            x_save_requirements=False,
        )
        with _answering("wandb"):
            self._run = wandb.init(
                name=self._folder.resolve().name,
                dir=self._folder,
                id=self._id,
                resume="allow",
                project=self._cfg.project,
                mode=cast(Any, self._cfg.mode),
                config=to_dict(trainer.config),
                settings=quiet,
            )
        # Its own step is the iteration: after the last frame there are more of these, which would be one row.
        self._run.define_metric("*", step_metric="frames")

    def write(self, row: Row) -> None:
        """Log the row."""
        self._run.log(known(row), step=int(row["iteration"] or 0))

    def results(self, found: FinalResults, trainer: Training) -> None:
        """Log the pictures, leave the final figures in the summary, and add the policy as an artifact."""
        import wandb

        images = {name: wandb.Image(picture) for name, picture in found.pictures.items()}
        self._run.log(images, step=trainer.position.iteration)
        self._run.summary.update(found.figures)
        artifact = wandb.Artifact(f"policy-{self._id}", type="model")
        artifact.add_file(str(found.policy))
        self._run.log_artifact(artifact)

    def close(self, error: BaseException | None) -> None:
        """Close the run."""
        self._run.finish(exit_code=0 if error is None else 1)


class MlflowLogger(_Tracker):
    """MLflow: the options as parameters, a row per logged iteration, final figures, pictures, the policy.

    By MLflow's client itself, for TorchRL's logger always begins another run. A resumed run goes on with the same one;
    rows that an earlier process logged after its last checkpoint are not logged twice.
    """

    name = "mlflow"
    _cfg: MlflowConfig
    _logged = 0  # iteration of the last row that is there

    def on_start(self, trainer: Training) -> None:
        """Begin the run, or go on with it.

        Raises:
            RunError: the server or the database cannot be reached.
            UserError: the database of the run's folder is a link, or no ordinary file.
        """
        if self._cfg.uri is None:
            # SQLite would follow a link out of the folder; an empty file is a new database to it.
            os.close(reopen(self._folder / "mlflow.db"))
            # Reports of how mlflow is used would go out over the network from a run that is to stay here.
            os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        # Its database reports on standard error which tables it makes, and the traceback of each error that it raises.
        os.environ.setdefault("MLFLOW_LOGGING_LEVEL", "CRITICAL")
        from mlflow import MlflowClient

        uri = self._cfg.uri or f"sqlite:///{self._folder.resolve() / 'mlflow.db'}"
        with _answering("mlflow"):
            self._client = MlflowClient(uri)
            if not self._id:
                self._begin(trainer)
            else:
                self._client.update_run(self._id, status="RUNNING")
                rows = self._client.get_metric_history(self._id, "iteration")
                self._logged = max((int(row.value) for row in rows), default=0)

    def _begin(self, trainer: Training) -> None:
        from mlflow.entities import Param
        from mlflow.exceptions import MlflowException

        # The default place of artifacts is a folder where the command was typed.
        place = (self._folder.resolve() / "mlflow").as_uri() if self._cfg.uri is None else None
        try:
            number = self._client.create_experiment(self._cfg.experiment, place)
        except MlflowException:
            # It is there, perhaps since another run of the sweep has made it just now.
            if not (found := self._client.get_experiment_by_name(self._cfg.experiment)):
                raise
            number = found.experiment_id
        run = self._client.create_run(number, run_name=self._folder.resolve().name)
        self._id = run.info.run_id
        options = [Param(*each) for each in typed(trainer).items()]
        for begin in range(0, len(options), 100):  # no more are taken at a time
            self._client.log_batch(self._id, params=options[begin : begin + 100])

    def write(self, row: Row) -> None:
        """Log the row, unless it is there."""
        measured = known(row)
        if measured["iteration"] > self._logged:
            self._log(measured, int(measured["iteration"]))

    def _log(self, row: Mapping[str, float], iteration: int) -> None:
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        with _answering("mlflow"):
            self._client.log_batch(
                self._id, metrics=[Metric(key, value, now, iteration) for key, value in row.items()]
            )

    def results(self, found: FinalResults, trainer: Training) -> None:
        """Log the final figures, and pictures and policy as artifacts."""
        self._log(found.figures, trainer.position.iteration)
        with _answering("mlflow"):
            for name, picture in found.pictures.items():
                self._client.log_image(self._id, picture, f"{name}.png")
            self._client.log_artifact(self._id, found.policy)

    def close(self, error: BaseException | None) -> None:
        """Note how the run ended."""
        ended = "KILLED" if isinstance(error, Preempted) else "FAILED"
        with _answering("mlflow"):
            self._client.set_terminated(self._id, "FINISHED" if error is None else ended)


@contextmanager
def _answering(name: str) -> Iterator[None]:
    """One line where a logger cannot do its work; the run can be resumed."""
    try:
        yield
    except Exception as error:  # any error of the package, its network or its database
        raise RunError(f"log=[{name}]: {reason(error)}") from error
