"""Schema of each command."""

from __future__ import annotations

from typing import Any

from trackmdp.config import counting, credit, given, hidden_kernels, sweeping  # noqa: F401  (more to choose from)
from trackmdp.config.baselines import BaselineConfig
from trackmdp.config.by_blocks import PartitionConfig, SweptPartitionConfig
from trackmdp.config.learning import DEVICE, AlgoConfig, CollectorConfig
from trackmdp.config.logs import LogConfig
from trackmdp.config.options import (
    GROUPS,
    NodeConfig,
    Reasons,
    count_option,
    file_option,
    listed,
    option,
    options,
    refuse,
    share_option,
)
from trackmdp.config.sensors import CostConfig, SensorConfig
from trackmdp.config.several import MergedTargetsConfig, TargetsConfig, WidthConfig
from trackmdp.config.world import GridConfig, KernelConfig, TaskConfig
from trackmdp.errors import UserError


class CommandConfig(NodeConfig):
    """Common options of all commands."""

    learns = False
    quiet: bool = option("print nothing but errors")


class WorldConfig(CommandConfig):
    """Common options of the commands in a world."""

    needs_motion = True
    all_prices = False
    """Whether the command sets the prices of sensors itself; those given are then ratios."""
    any_number = False
    """Whether the command is about policies with any number of sensors on."""
    grid: GridConfig
    kernel: KernelConfig
    cost: CostConfig
    sensor: SensorConfig


class EvaluationConfig(WidthConfig):
    """How often the policy is evaluated while it learns."""

    every: int = count_option("iterations from one exact evaluation to the next", unit="iterations")


class OptimalBoundConfig(NodeConfig):
    """The certified optimum beside the policy's figures."""

    enabled: bool = option("solve for the optimum at the end")
    nodes: int = count_option("choices of branch and bound after which solving stops", unit="nodes")
    time_limit: float | None = option(
        "stop after this time even so; regrets then depend on the machine, and the output names it; null = never",
        unit="s",
        gt=0,
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
    keep: int = count_option("newest checkpoints kept")


class ComputingConfig(WorldConfig):
    """Common options of the commands that compute by torch."""

    device: str = option(
        "device of networks and of simulations",
        expects="cpu, cuda, cuda:N or auto",
        pattern=DEVICE,
    )
    threads: int = count_option("torch threads of this process", unit="threads", le=256)


class TrainConfig(ComputingConfig):
    """Learn a policy without the motion model, and evaluate it exactly."""

    needs_motion = False
    learns = True
    seed: int = option("every random draw of the run derives from it", ge=0)
    task: TaskConfig
    algo: AlgoConfig
    collector: CollectorConfig
    targets: MergedTargetsConfig
    partition: PartitionConfig
    log: dict[str, LogConfig]
    evaluation: EvaluationConfig
    optimal: OptimalBoundConfig
    checkpoint: CheckpointConfig
    resume: str | None = file_option(
        "go on with a run: auto = the one in hydra.run.dir, where there is one",
        "auto, a run's folder, a checkpoint",
        words=("auto",),
    )
    init_from: str | None = file_option(
        "start from the weights of another run, where shapes fit", "the folder of a run"
    )

    def check(self, key: str, root: Any) -> None:
        """Blocks and logged episodes are of a single target."""
        if self.targets.count > 1 and self.algo.joint:
            several = f"with targets.count={self.targets.count} and algo={self.algo.name}"
            if self.partition.block is not None:
                raise refuse("partition.block", self.partition.block, f"null {several}")


class EvaluateConfig(ComputingConfig):
    """Value a trained policy (run=) or a baseline (baseline=), exactly and by simulation."""

    needs_motion = False
    task: TaskConfig
    run: str | None = file_option(
        "folder of a training run; its world is taken from there", "the folder of a run"
    )
    baseline: BaselineConfig | None
    targets: MergedTargetsConfig
    evaluation: WidthConfig
    log: dict[str, LogConfig]
    seed: int = option("seed of the simulated episodes", ge=0)
    episodes: int = option("episodes simulated; 0 = exact figures only", unit="episodes", ge=0)

    def check(self, key: str, root: Any) -> None:
        """One policy is valued, and of its log only the episodes are written."""
        # Neither and both are one mistake: the two name the same thing, the policy to be valued.
        if (self.run is None) == (self.baseline is None):
            given = "neither" if self.run is None else "both"
            raise UserError(f"expected exactly one of run=FOLDER and baseline=NAME, got {given}")
        if self.targets.count > 1:
            # Plans that draw have no belief to merge.
            several = f"with targets.count={self.targets.count}"
            if self.baseline is not None and self.baseline.name in ("playback", "random_k"):
                raise refuse("baseline", self.baseline.name, f"one that does not draw {several}")
        if not all(node.episodes_only for node in self.log.values()):
            raise refuse("log", listed(self.log), "[mcap] or []; an evaluation has no iterations")
        if self.log and not self.episodes:
            raise refuse("episodes", 0, f"at least 1 with log={listed(self.log)}")

    def ignored(self, root: Any) -> Reasons:
        """Of several targets as many episodes are simulated as `evaluation.width` asks for, and logged as are named."""
        why = f"with targets.count={self.targets.count} and no log, where evaluation.width is met"
        return {"episodes": why} if self.targets.count > 1 and not self.log else {}


class CompareConfig(WorldConfig):
    """Policies side by side on one problem: the one of the first run, else the world of the options."""

    needs_motion = False
    task: TaskConfig
    runs: list[str] | None = file_option(
        "folders of training runs; run=A run=B is the same as runs=[A,B]", "the folder of a run"
    )
    baselines: list[str] | None = option(
        "policies that are not learned; baseline=A baseline=B is the same as baselines=[A,B]",
        expects="a baseline of evaluate",
    )

    def check(self, key: str, root: Any) -> None:
        """The baselines exist, and need no file, which cannot be named here."""
        known = [
            name for name, schema in GROUPS["baseline"].items() if "file" not in options(schema)
        ]
        for name in self.baselines or []:
            if name not in known:
                raise refuse("baseline", name, f"one of {', '.join(known)}")


class WholeEpisodesConfig(WorldConfig):
    """Common options of the commands about episodes that only the exit ends."""

    def check(self, key: str, root: Any) -> None:
        """No limit ends an episode."""
        if self.grid.max_steps is not None:
            raise refuse("grid.max_steps", self.grid.max_steps, "null, for whole episodes")


class SolverConfig(WholeEpisodesConfig):
    """Common options of the commands that solve."""

    task: TaskConfig
    solver: BaselineConfig


class SolveConfig(SolverConfig):
    """Solve the world with its motion model."""

    targets: TargetsConfig
    partition: SweptPartitionConfig
    verify: bool = option("check the paper's theorems on this world as well")


class FrontierConfig(SolverConfig):
    """Accuracy against sensors per step, over all prices of a sensor: the best policies, with a proof.

    D stays as it is, and its payments count; cost.safe=0 leaves them out.
    """

    all_prices = True
    accuracy: float | None = share_option(
        "show the mixture of policies of the frontier that has this accuracy"
    )
    sensors: float | None = option(
        "show the best policies with so many sensors", unit="sensors per step", ge=0
    )
    resolution: float = option(
        "height above an edge below which no further corner is looked for, in accuracy", gt=0, lt=1
    )


class VerifyConfig(WholeEpisodesConfig):
    """Check the paper's theorems on a world."""

    any_number = True
    verify = True
    """As of `solve verify=true`: the same worlds are refused."""
    tolerance: float = option("deviation that still counts as equal", unit="reward", gt=0, lt=1)


class ReplayConfig(CommandConfig):
    """Look at logged episodes, prove them, rebuild a damaged log; with file= alone, list the episodes."""

    file: str = file_option("the log", "a file written with log=[mcap]")
    episode: int | None = option(
        "play this episode; for html= and csv= the one that is written", ge=0
    )
    verify: bool = option("re-simulate every episode and name the first difference")
    recover: bool = option(
        "write every whole episode of a cut or damaged log to a new one beside it"
    )
    html: str | None = file_option(
        "write one episode (by default the first) as a web page", "a file to write"
    )
    csv: str | None = file_option("write steps.csv and episodes.csv", "a folder")
    layout: str | None = file_option("write the layout for viewers", "a file to write")
    speed: float = option("speed of playing", unit="steps/s", gt=0, le=1000)

    def ignored(self, root: Any) -> Reasons:
        """An episode is played where nothing else is asked for; layout and recover are of the whole log."""
        of_one, of_all = (self.html, self.csv, self.verify), (self.layout, self.recover)
        unread = {"speed": "where no episode is played, which episode=N alone does"}
        if not any(of_one + of_all):
            return unread if self.episode is None else {}
        why = "with layout= or recover=true, which are of the whole log"
        return unread if any(of_one) else unread | {"episode": why}


class ReportConfig(CommandConfig):
    """Make figures, tables and one web page of a sweep, or watch it run."""

    sweep: str = file_option(
        "folder of the sweep, or of stored results", "the folder of a sweep or an earlier report"
    )
    watch: bool = option("show all runs live until they are done, instead of a report")
    paper: bool | None = option(
        "add the sections on the paper; null = where the runs cover its twelve worlds"
    )
    threshold: float | None = option(
        "count the runs with a regret of at most this", unit="reward/step", gt=0
    )
    every: float = option(
        "seconds from one look at the runs to the next, with watch=true", unit="s", gt=0, le=3600
    )

    def ignored(self, root: Any) -> Reasons:
        """A watch looks again and again, and makes no report."""
        names = ("paper", "threshold") if self.watch else ("every",)
        return dict.fromkeys(names, f"with watch={str(self.watch).lower()}")


class ExportConfig(CommandConfig):
    """Write a learned policy as a file that runs without this package."""

    run: str = file_option("folder of a training run", "the folder of a run")
    format: str = option(
        "onnx: policy.onnx, pt2: policy.pt2 for torch.export, sets: sets.json, geojson: cells on a map with value and "
        "sensors",
        choices=("onnx", "pt2", "sets", "geojson"),
    )
    checkpoint: str = option(
        "newest checkpoint of the run, or best: of the largest AIHTR by the motion, which no learner knows, with "
        "kernel=tracks on the validation tracks",
        choices=("newest", "best"),
    )


ROOTS: dict[str, type[CommandConfig]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "compare": CompareConfig,
    "solve": SolveConfig,
    "frontier": FrontierConfig,
    "verify": VerifyConfig,
    "replay": ReplayConfig,
    "export": ExportConfig,
    "report": ReportConfig,
}
"""Command -> its schema; `conf/<command>.yaml` holds the values."""
