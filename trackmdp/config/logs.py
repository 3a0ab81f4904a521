"""Schema of the logs of a training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from trackmdp.config.options import ChoiceConfig, Reasons, choice, count_option, option
from trackmdp.errors import require


class LogConfig(ChoiceConfig):
    """Base of the group `log`: files of figures by iteration, next to `summary.json`; any of them together.

    The code of a choice gets its config and the folder of the run, and returns a callback of the training.
    """

    episodes_only = False
    package: ClassVar[str | None] = None
    """A package beyond the dependencies of trackmdp; the extra with the name of the choice adds it."""


class RowsConfig(LogConfig):
    """A row for each iteration that is due."""

    every: int = count_option("iterations from one row to the next", unit="iterations")


@choice("log", "csv", makes="trackmdp.training.loggers:CsvLogger")
class CsvConfig(RowsConfig):
    """`metrics.csv`, which a training always writes: without this choice a row for every iteration."""


@choice("log", "tensorboard", makes="trackmdp.training.result_loggers:TensorboardLogger")
class TensorboardConfig(RowsConfig):
    """TensorBoard event files."""

    package = "tensorboard"


@choice("log", "wandb", makes="trackmdp.training.result_loggers:WandbLogger")
class WandbConfig(RowsConfig):
    """Weights & Biases. `wandb sync` uploads an offline log, in the folder of the run."""

    package = "wandb"
    mode: str = option(
        "offline = to files alone, online = to the server", choices=("offline", "online")
    )
    project: str = option("project of the run", expects="a name", pattern=r"[\w .-]{1,128}")


@choice("log", "mlflow", makes="trackmdp.training.result_loggers:MlflowLogger")
class MlflowConfig(RowsConfig):
    """MLflow, in a database or on a server."""

    package = "mlflow"
    uri: str | None = option(
        "tracking database or server; null = mlflow.db in the run's folder", expects="a URI"
    )
    experiment: str = option("experiment of the run", expects="a name", pattern=r"[\w .-]{1,128}")


@choice("log", "mcap", makes="trackmdp.episodes.log:EpisodeLogger")
class McapConfig(LogConfig):
    """`episodes.mcap`: simulated episodes, step by step, for `replay` and viewers."""

    episodes_only = True
    evaluations: int = count_option(
        "training: from one recorded evaluation to the next; the last is recorded too",
        unit="evaluations",
    )
    episodes: int = count_option(
        "training: episodes recorded of each such evaluation", unit="episodes", le=10**6
    )
    layout: bool = option("write a viewer's layout next to the log")

    def ignored(self, root: Any) -> Reasons:
        """An evaluation logs all the episodes that it simulates."""
        return {} if root.learns else dict.fromkeys(("evaluations", "episodes"), "outside training")


def require_packages(log: Mapping[str, LogConfig]) -> None:
    """Check that the packages of the loggers are installed, before the folder of the run is made.

    Raises:
        UserError: a package is not installed.
    """
    for name, node in log.items():
        if node.package is not None:
            require(node.package, name, f"log=[{name}]")
