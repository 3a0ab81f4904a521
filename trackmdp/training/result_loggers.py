"""Loggers that end with the results of a run, and TensorBoard's among them."""

from __future__ import annotations

import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trackmdp.config import to_dict, to_yaml
from trackmdp.config.tree import flatten
from trackmdp.durable import own_folder
from trackmdp.notebook.drawing import drawn
from trackmdp.solvers.evaluation import figures
from trackmdp.training.callbacks import Row, Training
from trackmdp.training.loggers import RowLogger, known
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
