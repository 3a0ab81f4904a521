"""Schema of sweeps: `hydra/sweeper` chooses the runs, `hydra/launcher` their place."""

from __future__ import annotations

from typing import Any

from trackmdp.cluster import ADDRESS, joining
from trackmdp.config.options import ChoiceConfig, choice, count_option, option
from trackmdp.errors import UserError, require

PLUGINS = ("launcher", "sweeper")
"""Parts of Hydra with choices of this package: `hydra/launcher`, `hydra/sweeper`."""


class PluginConfig(ChoiceConfig):
    """Base of both groups."""

    package = ""
    """Imported package; `extra` is the extra of this package that adds it."""
    extra = ""

    def check(self, key: str, root: Any) -> None:
        """The package is installed."""
        if self.package:
            require(self.package, self.extra, f"{key.replace('.', '/')}={self.name}")


class SweeperConfig(PluginConfig):
    """Base of the group `hydra/sweeper`: the runs of a sweep.

    The code of a choice gets its config, the typed words, the folder of the sweep, and a function that makes jobs
    of words (`plan` without its first arguments); it returns batches of jobs, and a search plans each when asked.
    """


@choice("hydra/sweeper", "blocks", makes="trackmdp.app.sweep.plan:grid")
class BlocksConfig(SweeperConfig):
    """Every combination of the values in each block; typed words are added to each, or replace its words."""

    blocks: list[str] | None = option(
        "grids that together are the sweep; null = one of the typed words",
        expects="a line of words",
    )


@choice("hydra/sweeper", "optuna", makes="trackmdp.app.sweep.trials:trials")
class OptunaConfig(SweeperConfig):
    """A search over the words with several values, `range(a,b)` or `interval(a,b)`."""

    package = extra = "optuna"
    n_trials: int = count_option(
        "runs of the whole study, those of earlier calls among them", unit="runs"
    )
    objective: str = option(
        "the largest AIHTR, or the least regret to the bound that each run proves in optimal.nodes; both are computed "
        "with the motion, or with kernel=tracks on the validation tracks",
        choices=("aihtr", "regret_per_step"),
    )
    sampler: str = option("how the next run is chosen", choices=("tpe", "random"))
    seed: int = option("every choice derives from it", ge=0)
    batch: int = count_option("runs chosen at once, for launchers that run several", unit="runs")
    study: str = option("name of the study in its storage", expects="a name")
    storage: str | None = option(
        "database of the study; null = study.db in the sweep's folder",
        expects="a URL such as sqlite:///studies.db",
    )


class LauncherConfig(PluginConfig):
    """Base of the group `hydra/launcher`: the place of the runs of a sweep.

    The code of a choice gets its config and jobs, and returns once none of them is running.
    """

    concurrent = True


@choice("hydra/launcher", "basic", makes="trackmdp.app.sweep.launchers:run_basic")
class BasicConfig(LauncherConfig):
    """One run after the other, on this machine."""

    concurrent = False


@choice("hydra/launcher", "joblib", makes="trackmdp.app.sweep.launchers:run_joblib")
class JoblibConfig(LauncherConfig):
    """Several runs at once, on this machine."""

    package, extra = "joblib", "sweep"

    n_jobs: int | None = count_option(
        "runs at once; null = one for each core", unit="runs", le=1024
    )


class SubmititConfig(LauncherConfig):
    """Base of the launchers that write a submission for each run."""

    package, extra = "submitit", "slurm"

    timeout_min: int = count_option(
        "a run is stopped after this long, and resumes where requeued", unit="min"
    )
    cpus_per_task: int = count_option("cores of a run", unit="cores")


@choice("hydra/launcher", "submitit_local", makes="trackmdp.app.sweep.launchers:run_here")
class SubmititLocalConfig(SubmititConfig):
    """As submitit_slurm, but on this machine: to try out a cluster."""

    n_jobs: int | None = count_option(
        "runs at once; null = as many as there are cores for", unit="runs", le=1024
    )


@choice("hydra/launcher", "submitit_slurm", makes="trackmdp.app.sweep.launchers:run_on_slurm")
class SubmititSlurmConfig(SubmititConfig):
    """On the nodes of a SLURM cluster, as one job array; the folder must be one that every node sees."""

    mem_gb: float | None = option("memory of a run; null = the cluster's default", unit="GB", gt=0)
    gpus_per_node: int | None = option("GPUs of a run; null = none asked for", unit="GPUs", ge=0)
    array_parallelism: int = count_option("runs at once", unit="runs")
    max_num_timeout: int = option("times that a run that is out of time is requeued", ge=0)
    signal_delay_s: int = count_option("a run saves this long before its time is out", unit="s")
    partition: str | None = option("partition; null = the cluster's default", expects="its name")
    account: str | None = option("account; null = the user's default", expects="its name")
    setup: list[str] | None = option(
        "lines of shell before each run, such as `module load ...`", expects="a line"
    )
    additional_parameters: dict[str, str] | None = option(
        "further `#SBATCH` parameters", expects="{name: value}"
    )

    def check(self, key: str, root: Any) -> None:
        """There is a cluster: submitting would fail only after the sweep's folder has been made."""
        super().check(key, root)
        import submitit

        if submitit.SlurmExecutor.affinity() < 0:
            raise UserError(
                "hydra/launcher=submitit_slurm: expected a machine from which jobs can be submitted (no srun)"
            )


@choice("hydra/launcher", "ray", makes="trackmdp.app.sweep.launchers:run_on_ray")
class RayConfig(LauncherConfig):
    """On a Ray cluster that is joined, or one that is started on this machine: for many runs on many machines.

    On one machine joblib does the same for less.
    """

    package = extra = "ray"

    address: str | None = option(
        "cluster to join; null = start one here", expects="auto, or host:port", pattern=ADDRESS
    )
    num_cpus: int | None = count_option("cores of a cluster started here; null = all", unit="cores")
    cpus_per_run: float = option("cores of a run", unit="cores", gt=0)
    gpus_per_run: float = option("GPUs of a run", unit="GPUs", ge=0)

    def check(self, key: str, root: Any) -> None:
        """The cluster is there: joining it would fail only after the sweep's folder has been made."""
        super().check(key, root)
        with joining(f"{key}.address", self.address):
            pass
