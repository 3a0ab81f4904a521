"""Schema of each command: what can be set for it."""

from __future__ import annotations

from typing import Any, ClassVar

from trackmdp.cluster import ADDRESS
from trackmdp.config import counting, modes, per_sensor, sweeping  # noqa: F401  (more to choose from)
from trackmdp.config.baselines import BaselineConfig
from trackmdp.config.learning import DEVICE, AlgoConfig, CollectorConfig
from trackmdp.config.loggers import LogConfig
from trackmdp.config.options import GROUPS, NodeConfig, listed, option, refuse
from trackmdp.config.partition import PartitionConfig, SweptPartitionConfig
from trackmdp.config.sensing import CostConfig, SensorConfig
from trackmdp.config.world import GridConfig, KernelConfig, TaskConfig
from trackmdp.errors import UserError


class CommandConfig(NodeConfig):
    """What every command has."""

    learns: ClassVar[bool] = False
    quiet: bool = option("say nothing at the terminal but errors")


class WorldConfig(CommandConfig):
    """What every command has that takes place in a world."""

    needs_motion: ClassVar[bool] = True
    knows_modes: ClassVar[bool] = True
    """Whether the target may have a hidden mode."""
    grid: GridConfig
    kernel: KernelConfig
    cost: CostConfig
    sensor: SensorConfig

    @property
    def remembered(self) -> dict[str, Any]:
        """What policies remember, as arguments of `Task`: the cell, where the command has no options of it."""
        task: TaskConfig | None = getattr(self, "task", None)
        return {} if task is None else {"memory": task.memory, "clip": task.clip}


class EvaluationConfig(NodeConfig):
    """How often the policy is evaluated while it learns."""

    every: int = option("iterations from one exact evaluation to the next", unit="iterations", ge=1)


class OptimalBoundConfig(NodeConfig):
    """The certified optimum beside the policy's figures."""

    enabled: bool = option("solve for the optimum at the end")
    nodes: int = option("choices of branch and bound after which solving stops", unit="nodes", ge=1)
    time_limit: float | None = option(
        "stop after this long even so; regrets then depend on the machine, and say so; null = never", unit="s", gt=0
    )


class CheckpointConfig(NodeConfig):
    """When the state of the run is saved."""

    every: int = option(
        "frames from one checkpoint to the next, the best of which is best.pt; 0 = not counted in frames",
        unit="frames",
        ge=0,
    )
    seconds: float | None = option(
        "time from one checkpoint to the next, longer where saving would take over 2 %; null = not by time",
        unit="s",
        gt=0,
    )
    keep: int = option("newest checkpoints kept", ge=1)


class TrainConfig(WorldConfig):
    """Learn a policy without the motion model, and evaluate it exactly."""

    needs_motion: ClassVar[bool] = False
    learns: ClassVar[bool] = True
    seed: int = option("every random draw of the run derives from it", ge=0)
    device: str = option("device the networks live on", expects="cpu, cuda, cuda:N or auto", pattern=DEVICE)
    threads: int = option("torch threads of the learning process", unit="threads", ge=1, le=256)
    task: TaskConfig
    algo: AlgoConfig
    collector: CollectorConfig
    partition: PartitionConfig
    log: dict[str, LogConfig]
    evaluation: EvaluationConfig
    optimal: OptimalBoundConfig
    checkpoint: CheckpointConfig
    resume: str | None = option(
        "go on with a run: auto = the one in hydra.run.dir, where there is one",
        expects="auto, a run's folder, a checkpoint",
        path=True,
        words=("auto",),
    )
    init_from: str | None = option(
        "start from the weights of another run, where shapes fit", expects="the folder of a run", path=True
    )


class EvaluateConfig(WorldConfig):
    """Value a trained policy (run=) or a baseline (baseline=), exactly and by simulation."""

    needs_motion: ClassVar[bool] = False
    task: TaskConfig
    run: str | None = option(
        "folder of a training run; its world is taken from there", expects="the folder of a run", path=True
    )
    baseline: BaselineConfig | None
    log: dict[str, LogConfig]
    seed: int = option("seed of the simulated episodes", ge=0)
    device: str = option("device of the simulation", expects="cpu, cuda, cuda:N or auto", pattern=DEVICE)
    threads: int = option("torch threads", unit="threads", ge=1, le=256)
    episodes: int = option("episodes simulated; 0 = exact figures only", unit="episodes", ge=0)

    def check(self, key: str, root: Any) -> None:
        """One policy is valued, and of its log only the episodes are written."""
        # Neither and both are one mistake: the two name the same thing, the policy to be valued.
        if (self.run is None) == (self.baseline is None):
            given = "neither" if self.run is None else "both"
            raise UserError(f"expected exactly one of run=FOLDER and baseline=NAME, got {given}")
        if not all(node.episodes_only for node in self.log.values()):
            raise refuse("log", listed(self.log), "[mcap] or []; an evaluation has no iterations")


class SolveConfig(WorldConfig):
    """Solve the world with its motion model."""

    task: TaskConfig
    solver: BaselineConfig
    partition: SweptPartitionConfig
    verify: bool = option("check the paper's theorems on this world as well")


class VerifyConfig(WorldConfig):
    """Check the paper's theorems on a world."""

    tolerance: float = option("deviation that still counts as equal", unit="reward", gt=0, lt=1)

    def check(self, key: str, root: Any) -> None:
        """The theorems are on sensors of one cell."""
        if self.sensor.covers:
            raise refuse("sensor", self.sensor.name, "perfect or miss; the theorems are on sensors of one cell")


_PARTS = ("env", "collector", "train", "size", "handoff", "memory", "peers", "log", "regret", "bracket", "workers")


class BenchmarkConfig(WorldConfig):
    """Measure time and memory on this machine; how good the policies are, sweeps and reports say."""

    knows_modes: ClassVar[bool] = False
    part: str = option("what is measured", choices=_PARTS)
    seed: int = option("every random draw derives from it", ge=0)
    device: str = option("device of environments and networks", expects="cpu, cuda, cuda:N or auto", pattern=DEVICE)
    threads: int = option("torch threads", unit="threads", ge=1, le=256)
    seconds: float = option("least time spent on each figure of speed", unit="s", gt=0)
    batch_sizes: list[int] = option("`env`: environments stepped together", unit="environments", ge=1)
    sizes: list[int] = option("`size`: sides of the grid", unit="cells", ge=3)
    work: list[str] = option("`size`: kinds of work", choices=("solve", "train", "env"))
    # Its own default budget: that of `hindsight` takes hours from N = 40 on, `learned_kernel`'s seconds.
    learner: str = option("`size`: algorithm that trains, with its own budget", choices=tuple(GROUPS["algo"]))
    blocks: list[int] = option("`handoff`, `workers`: sides of the blocks", unit="cells", ge=1)
    halos: list[int] = option("`handoff`: cells around a block, besides the default", unit="cells", ge=0)
    workers: list[int] = option(
        "`workers`: of each row, to plan by blocks of the first of `blocks`", unit="processes", ge=1
    )
    cluster: str | None = option(
        "`workers`: Ray cluster that they are of; null = no Ray",
        expects="local, auto, or host:port",
        pattern=f"local|{ADDRESS}",
    )
    # Evaluated while this module is imported, before plugins are: only this package's own algorithms.
    algos: list[str] = option("`memory`: algorithms that train", choices=tuple(GROUPS["algo"]))
    seeds: list[int] = option("`peers`, `regret`: seeds that all train with", ge=0)
    worlds: list[str] | None = option("`regret`, `bracket`: words that a world's name holds; null for all worlds")
    nodes: int = option("`regret`, `bracket`: choices that branch and bound looks at", unit="nodes", ge=1)
    peers: str = option(
        "`peers`: folder with the scripts <name>_peer.py to run beside ours",
        expects="the folder of the scripts",
        path=True,
    )
    peers_seconds: float = option("`peers`: how long a peer learns", unit="s", gt=0)

    def check(self, key: str, root: Any) -> None:
        """What the peers are made for."""
        if self.part == "peers" and self.sensor.name != "perfect":
            raise refuse("sensor", self.sensor.name, "perfect with part=peers, whose scripts know no other")


class ReplayConfig(CommandConfig):
    """Look at logged episodes, prove them, rebuild a damaged log; without more than file=, list what it holds."""

    file: str = option("the log", expects="a file written with log=[mcap]", path=True)
    episode: int | None = option("play this episode; for html= and csv= the one that is written", ge=0)
    verify: bool = option("re-simulate every episode and name the first difference")
    recover: bool = option("write every whole episode of a cut or damaged log to a new one beside it")
    html: str | None = option(
        "write one episode (by default the first) as a web page", expects="a file to write", path=True
    )
    csv: str | None = option("write steps.csv and episodes.csv", expects="a folder", path=True)
    layout: str | None = option("write the layout for viewers", expects="a file to write", path=True)
    speed: float = option("speed of playing", unit="steps/s", gt=0, le=1000)


class ReportConfig(CommandConfig):
    """Make figures, tables and one web page of a sweep, or watch it run."""

    sweep: str = option(
        "folder of the sweep, or of stored results", expects="the folder of a sweep or an earlier report", path=True
    )
    watch: bool = option("show all runs live until they are done, instead of a report")
    paper: bool | None = option("add what concerns the paper's settings; null = where the runs cover its twelve worlds")
    threshold: float | None = option(
        "count the runs that end at most this far from the bound", unit="reward/step", gt=0
    )
    every: float = option("seconds from one look at the runs to the next, with watch=true", unit="s", gt=0, le=3600)


class ExportConfig(CommandConfig):
    """Write a learned policy as a file that runs without this package."""

    run: str = option("folder of a training run", expects="the folder of a run", path=True)
    format: str = option(
        "torch_export: policy.pt2, onnx: policy.onnx, sets: sets.json", choices=("torch_export", "onnx", "sets")
    )
    checkpoint: str = option(
        "which of the run's checkpoints; best = of the largest AIHTR: the oracle's choice, made with the motion no "
        "learner knows, and with kernel=tracks the validation tracks'",
        choices=("newest", "best"),
    )


ROOTS: dict[str, type[CommandConfig]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "solve": SolveConfig,
    "verify": VerifyConfig,
    "benchmark": BenchmarkConfig,
    "replay": ReplayConfig,
    "export": ExportConfig,
    "report": ReportConfig,
}
"""Command -> its schema; `conf/<command>.yaml` holds the values."""
