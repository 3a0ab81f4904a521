"""Schema of the algorithm that counts what follows each key on fully sensed paths."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from trackmdp.config.learning import AlgoConfig
from trackmdp.config.options import choice, option
from trackmdp.config.schema import BYTES, Sizes


@choice("algo", "path_counts", makes="trackmdp.algos.path_counts:PathCounts")
@dataclass(kw_only=True)
class PathCountsConfig(AlgoConfig):
    """Collect with all sensors on, then count on those paths what sensing gains after each key; no networks.

    Every path is replayed from its start, so that the keys are as frequent as the policy's own make them.
    """

    credit: ClassVar[str | None] = None
    remembers: ClassVar[bool] = True
    prior: float | None = option(
        "what is known without the cell counts as much as so many detections; null: chosen, as is whether plans are "
        "improved by exchange, by a quarter of the paths, which then count as well",
        ge=0,
    )
    gamma: float = option("discount inside the credit; policies are evaluated undiscounted", ge=0, le=1)
    rounds: int = option("rounds of policy iteration after each batch at most", ge=1)

    def needs(self, task: Sizes, root: Any) -> dict[str, int]:
        """The paths, and for each detection that may be on them what is worked out of it."""
        per_frame = (task.t_max + 3) ** task.order * (task.t_max + 2) * 12
        return {"algo.total_frames": root.collector.total_frames * per_frame * BYTES["float64"]}
