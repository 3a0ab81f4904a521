"""Schema of sweeps: `hydra/sweeper` says which runs there are, `hydra/launcher` where they are run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

from omegaconf import OmegaConf

from trackmdp.config.options import leaves, option, refuse
from trackmdp.errors import UserError

T = TypeVar("T")

PLUGINS: dict[str, dict[str, type[Any]]] = {"launcher": {}, "sweeper": {}}
"""Group of `hydra` -> option of the group -> its dataclass."""


def _offered(group: str, name: str) -> Callable[[type[T]], type[T]]:
    """Class decorator: make a dataclass the option `name` of the group `hydra/<group>`."""

    def register(schema: type[T]) -> type[T]:
        schema.name = name  # type: ignore[attr-defined]
        PLUGINS[group][name] = schema
        return schema

    return register


def plugin(group: str, node: Any) -> Any:
    """The typed, checked options of `hydra.<group>`.

    Raises:
        UserError: a value is out of its range, or the option chosen is none of ours.
    """
    schema = OmegaConf.get_type(node)
    if schema not in PLUGINS[group].values():
        raise UserError(f"hydra/{group}: expected one of {', '.join(PLUGINS[group])}")
    typed = OmegaConf.to_object(node)
    for key, described, value in leaves(typed, f"hydra.{group}."):
        if not described.allows(value):
            raise refuse(key, value, described.expected)
    return typed


@dataclass(kw_only=True)
class SweeperConfig:
    """Base of the group `hydra/sweeper`: which runs a sweep has."""

    name: ClassVar[str]


@_offered("sweeper", "blocks")
@dataclass(kw_only=True)
class BlocksConfig(SweeperConfig):
    """Every combination of the values in each block; what is typed is added to each, or replaces its words."""

    blocks: list[str] | None = option(
        "grids whose union is the sweep; null = one of the typed words", expects="a line of words"
    )


@_offered("sweeper", "optuna")
@dataclass(kw_only=True)
class OptunaConfig(SweeperConfig):
    """A search: the words with several values, `range(a,b)` or `interval(a,b)` say what is searched."""

    n_trials: int = option("runs of the whole study, those of earlier calls among them", unit="runs", ge=1)
    objective: str = option(
        "what is searched for: the largest AIHTR, or the least regret to the bound that each run proves in "
        "optimal.nodes; both are made out with the motion, or with kernel=tracks on the validation tracks",
        choices=("aihtr", "regret_per_step"),
    )
    sampler: str = option("how the next run is chosen", choices=("tpe", "random"))
    seed: int = option("every choice derives from it", ge=0)
    batch: int = option("runs chosen at once, for launchers that run several", unit="runs", ge=1)
    study: str = option("name of the study in its storage", expects="a name")
    storage: str | None = option(
        "database of the study; null = study.db in the sweep's folder", expects="a URL such as sqlite:///studies.db"
    )


@dataclass(kw_only=True)
class LauncherConfig:
    """Base of the group `hydra/launcher`: where the runs of a sweep take place."""

    name: ClassVar[str]


@_offered("launcher", "basic")
@dataclass(kw_only=True)
class BasicConfig(LauncherConfig):
    """One run after the other, on this machine."""


@_offered("launcher", "joblib")
@dataclass(kw_only=True)
class JoblibConfig(LauncherConfig):
    """Several runs at once, on this machine."""

    n_jobs: int | None = option("runs at once; null = one for each core", unit="runs", ge=1, le=1024)


@dataclass(kw_only=True)
class SubmititConfig(LauncherConfig):
    """Base of the launchers that write a submission for each run."""

    timeout_min: int = option("a run is stopped after this long, and resumes where requeued", unit="min", ge=1)
    cpus_per_task: int = option("cores of a run", unit="cores", ge=1)


@_offered("launcher", "submitit_local")
@dataclass(kw_only=True)
class SubmititLocalConfig(SubmititConfig):
    """As submitit_slurm, but on this machine: to try out what a cluster will do."""

    n_jobs: int | None = option("runs at once; null = as many as there are cores for", unit="runs", ge=1, le=1024)


@_offered("launcher", "submitit_slurm")
@dataclass(kw_only=True)
class SubmititSlurmConfig(SubmititConfig):
    """On the nodes of a SLURM cluster, as one job array; the folder must be one that every node sees."""

    mem_gb: float | None = option("memory of a run; null = the cluster's default", unit="GB", gt=0)
    gpus_per_node: int | None = option("GPUs of a run; null = none asked for", unit="GPUs", ge=0)
    array_parallelism: int = option("runs at once", unit="runs", ge=1)
    max_num_timeout: int = option("how often a run that is out of time is requeued", ge=0)
    signal_delay_s: int = option("a run is told to save this long before its time is out", unit="s", ge=1)
    partition: str | None = option("partition; null = the cluster's default", expects="its name")
    account: str | None = option("account; null = the user's default", expects="its name")
    setup: list[str] | None = option("lines of shell before each run, such as `module load ...`", expects="a line")
    additional_parameters: dict[str, str] | None = option("further `#SBATCH` parameters", expects="{name: value}")


@_offered("launcher", "ray")
@dataclass(kw_only=True)
class RayConfig(LauncherConfig):
    """On a Ray cluster that is joined, or one that is started on this machine: for many runs on many machines.

    On one machine joblib does the same for less.
    """

    address: str | None = option("cluster to join; null = start one here", expects="auto, or host:port")
    num_cpus: int | None = option("cores of a cluster started here; null = all", unit="cores", ge=1)
    cpus_per_run: float = option("cores of a run", unit="cores", gt=0)
    gpus_per_run: float = option("GPUs of a run", unit="GPUs", ge=0)
