"""Schema of planning by blocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from trackmdp.config.options import option
from trackmdp.config.schema import NodeConfig


@dataclass(kw_only=True)
class PartitionConfig(NodeConfig):
    """Blocks of the grid that plan for themselves, each for its own cells; the whole is valued on the whole grid."""

    block: int | None = option("side of a block; null = the whole grid is one", unit="cells", ge=1)
    halo: int | None = option(
        "cells around its own that a block knows of; null = R (T_max + 2), R the reach of a move, which loses nothing",
        unit="cells",
        ge=0,
    )
    sweeps: int | None = option(
        "rounds of exchange over the whole grid after the blocks (solver=optimal), all values known, until none grows; "
        "null = at most 10 with the default halo, none with a halo of its own",
        unit="rounds",
        ge=0,
        le=1000,
    )
    workers: int = option(
        "processes that plan, or with a cluster of our own its cores; on one machine as many as it has cores",
        unit="processes",
        ge=1,
    )
    cluster: str | None = option(
        "Ray cluster that plans one large grid, worth it where one machine's cores are not enough; for many runs take "
        "hydra/launcher=ray. local = one on this machine with so many workers, for tests; null = no Ray",
        expects="local, auto, or host:port",
    )

    def ignored(self, root: Any) -> dict[str, str]:
        """Without blocks there is nothing to know of, or to share out."""
        why = "without partition.block, the whole grid being planned at once"
        return dict.fromkeys(("halo", "sweeps", "workers", "cluster"), why) if self.block is None else {}
