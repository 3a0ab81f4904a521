"""Schema of the algorithms without networks: they count what was seen, and plan with the counts."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, ClassVar

from trackmdp.config.learning import AlgoConfig, EveryTaskConfig, check_classes
from trackmdp.config.options import BYTES, Sizes, choice, option, refuse
from trackmdp.config.registry import choice_values


@choice("algo", "path_counts", makes="trackmdp.algos.path_counts:PathCounts")
class PathCountsConfig(AlgoConfig):
    """Collect with all sensors on, then count on those paths what sensing gains after each key; no networks.

    Every path is replayed from its start, so that the keys are as frequent as the policy's own make them.
    """

    credit: ClassVar[str | None] = None
    remembers: ClassVar[bool] = True
    prior: float | None = option(
        "what is known of a key by its cell, and by all but its cell, counts as so many detections; null: chosen, "
        "as is whether plans are improved by exchange, by a quarter of the paths, which then count as well",
        ge=0,
    )
    gamma: float = option("discount inside the credit; policies are evaluated undiscounted", ge=0, le=1)
    rounds: int = option("rounds of policy iteration at most", ge=1)

    def needs(self, task: Sizes, root: Any) -> dict[str, int]:
        """The paths, and for each detection that may be on them what is worked out of it."""
        per_frame = (task.t_max + 3) ** task.order * (task.t_max + 2) * 12
        return {"algo.total_frames": root.collector.total_frames * per_frame * BYTES["float64"]}


@choice("algo", "learned_kernel", makes="trackmdp.algos.learned_kernel:learner")
class LearnedKernelConfig(EveryTaskConfig):
    """Estimate the motion from detections, then plan with the estimate; no networks.

    Where a policy remembers more than the cell (task.memory), the estimate is that of algo=path_counts, with its
    options' own values: counts after each key, with back-off. It takes whole paths: 300,000 frames of 100 envs, say.
    """

    credit: ClassVar[str | None] = None
    sensing: str = option("all sensors on, or sets chosen by posterior sampling", choices=("all", "chosen"))
    warm_up: int = option("with chosen sets: env steps with all sensors on before them", unit="frames", ge=0)
    prior: float = option(
        "the pooled motion counts as much as this many moves out of each cell in kernels that are drawn, or used to "
        "infer moves from misses; for plans the counts themselves say how much",
        unit="moves",
        gt=0,
    )
    exit_prior: float = option("the pooled exit probability counts as much as this many moves", unit="moves", gt=0)
    plan_every: int | None = option(
        "with all sensors on: batches from one plan to the next; after the last one is planned in any case; null: six "
        "plans in a run, above 20,000 cells that one alone",
        ge=1,
    )
    negligible: float | None = option(
        "moves that are believed less likely are planned without; 0 = none are; null: where missing them costs next to "
        "nothing, by the prices",
        unit="per step",
        ge=0,
        lt=1,
    )
    share_cells: str | None = option(
        "count moves of all cells, or of those of one class, together that are as far from each border; null: of all "
        "cells where the moves seen do not tell them apart",
        expects="all, none, or a path to a .npy, .npz or .csv file of the class of each cell",
        path=True,
        words=("all", "none"),
    )
    rounds: int = option("EM rounds after each batch", ge=1, le=10**6)
    rounds_at_end: int = option("EM rounds after the last batch", ge=1, le=10**6)
    samples: int = option("kernels drawn for the uncertainty reported", ge=2, le=10**4)

    def check(self, key: str, root: Any) -> None:
        """The file of the classes is a table; where a detection tells the mode, cells do not move alike."""
        check_classes(f"{key}.share_cells", self)
        if root.kernel.hides and self.share_cells not in (None, "none"):
            raise refuse(f"{key}.share_cells", self.share_cells, "none or null with kernel.reveals=true")

    def ignored(self, root: Any) -> dict[str, str]:
        """With all sensors on throughout, nothing comes before chosen sets; no move is counted by its cell alone."""
        if root.task.memory != "cell":
            own = set(vars(self)) - {field.name for field in fields(AlgoConfig)}
            return dict.fromkeys(sorted(own), f"with task.memory={root.task.memory}; algo=path_counts has options")
        all_on = self.sensing != "chosen"
        return {"warm_up": "with algo.sensing=all"} if all_on else {"plan_every": "with algo.sensing=chosen"}

    def needs(self, task: Sizes, root: Any) -> dict[str, int]:
        """The paths where more than the cell is remembered; else little."""
        return self.of_keys().needs(task, root) if root.task.memory != "cell" else {}

    def of_keys(self) -> PathCountsConfig:
        """What is learned where more than the cell is remembered."""
        values = choice_values("algo", "path_counts", {})
        budget = {field.name: getattr(self, field.name) for field in fields(AlgoConfig)}
        return PathCountsConfig(**{field.name: values[field.name] for field in fields(PathCountsConfig)} | budget)
