"""Schema of the algorithm without networks: estimates from what was sensed, and plans with them."""

from __future__ import annotations

from typing import Any

from trackmdp.config.learning import EveryTaskConfig, renewed_table
from trackmdp.config.options import (
    BYTES,
    TABLE,
    Needs,
    Reasons,
    choice,
    count_option,
    file_option,
    option,
    refuse,
    share_option,
)


@choice("algo", "model_based", makes="trackmdp.algos.model_based:ModelBased")
class ModelBasedConfig(EveryTaskConfig):
    """Estimate the motion from what was sensed, then plan with the estimate; no networks.

    Pooled moves where the next move depends on the cell alone, whole paths where it does not.
    """

    knows_budget = True
    plans_at_end = True
    sensing: str | None = option(
        "all sensors on, or sets chosen by posterior sampling; null: all, with cost.budget chosen",
        choices=("all", "chosen"),
    )
    warm_up: int = option(
        "with chosen sets: env steps with all sensors on before them", unit="frames", ge=0
    )
    estimate: str | None = option(
        "pooled moves, or whole paths; null: moves where the next one depends on the cell alone, else by a quarter of "
        "the paths, which nothing else learns from",
        choices=("moves", "paths"),
    )
    prior: float | None = option(
        "of plans on paths: weight of the estimates that share a cell, or all but the cell, with a key, in detections; "
        "null: chosen by a quarter of the paths, as is the use of exchange",
        ge=0,
    )
    gamma: float = share_option(
        "of plans on paths: discount inside the credit; policies are evaluated undiscounted"
    )
    rounds: int = count_option(
        "rounds of expectation-maximisation at each plan at most, fifty times as many at the end; of policy iteration "
        "on paths",
        le=10**6,
    )
    plan_every: int | None = count_option(
        "batches from one plan to the next; the last batch has a plan in any case; null: each with chosen sets "
        "and pooled moves, else a few plans in a run"
    )
    share_cells: str | None = file_option(
        "count moves of all cells, or of those of one class, together that are as far from each border; null: of all "
        "cells where the sensed moves show no difference",
        "all, none, or a path to a .npy, .npz or .csv file of the class of each cell",
        pattern=f"all|none|{TABLE}",
        words=("all", "none"),
    )

    def chooses(self, budget: int | None) -> bool:
        """Whether it learns from chosen sets, not with all sensors on."""
        return self.sensing == "chosen" or budget is not None

    def check(self, key: str, root: Any) -> None:
        """All sensors keep to no budget; where a detection reveals the mode, cells do not move alike."""
        if self.sensing == "all" and root.cost.budget is not None:
            expected = f"chosen or null with cost.budget={root.cost.budget}"
            raise refuse(f"{key}.sensing", self.sensing, expected)
        if root.kernel.hides and root.kernel.reveals and self.share_cells not in (None, "none"):
            raise refuse(
                f"{key}.share_cells", self.share_cells, "none or null with kernel.reveals=true"
            )

    def ignored(self, root: Any) -> Reasons:
        """A budget allows no first steps with all sensors on; moves have no prior of keys, paths no classes."""
        found, limited, kernel = {}, root.cost.budget is not None, root.kernel
        if limited or self.sensing != "chosen":
            why = "cost.budget" if limited else f"algo.sensing={self.sensing or 'null'}"
            found["warm_up"] = f"with {why}"
        markov = getattr(kernel, "markov", not kernel.hides or kernel.reveals)
        if self.estimate == "moves" or (self.estimate is None and markov):
            why = (
                "algo.estimate=moves" if self.estimate else f"kernel={kernel.name}, of pooled moves"
            )
            found |= dict.fromkeys(("prior", "gamma"), f"with {why}")
        elif self.estimate == "paths" and not self.chooses(root.cost.budget):
            found["share_cells"] = "with algo.estimate=paths and all sensors on"
        return found

    def needs(self, task: Any, root: Any) -> Needs:
        """The paths, and the gains of each detection that may be on them; the table of chosen sets."""
        found = {"grid.size": renewed_table(task)} if self.chooses(root.cost.budget) else {}
        if task.markov or self.estimate == "moves":
            return found
        per_frame = (task.t_max + 3) ** task.order * (task.t_max + 2) * 12
        paths = root.collector.total_frames * per_frame * BYTES["float64"]
        return found | {"algo.total_frames": paths}
