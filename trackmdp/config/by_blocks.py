"""Schema of planning and learning by blocks."""

from __future__ import annotations

from typing import Any

from trackmdp.cluster import ADDRESS
from trackmdp.config.options import NodeConfig, Reasons, count_option, listed, option, refuse


class PartitionConfig(NodeConfig):
    """Blocks of the grid that plan or learn alone, for their own cells; the policy is valued on the whole grid."""

    block: int | None = count_option("side of a block; null = the whole grid is one", unit="cells")
    halo: int | None = option(
        "cells around its own that a block includes; null = R (T_max + 2), R the reach of a move, twice as many with "
        "two_displacements, and with footprints at least grid.window, which loses nothing",
        unit="cells",
        ge=0,
    )
    workers: int = count_option(
        "processes that plan or learn, best as many as the machine has cores; with partition.cluster=local its cores",
        unit="processes",
        le=1024,
    )
    cluster: str | None = option(
        "Ray cluster that works on one large grid, worth it where one machine's cores are not enough; for many runs "
        "take hydra/launcher=ray. local = one on this machine with so many workers, for tests; null = no Ray",
        expects="local, auto, or host:port",
        pattern=f"local|{ADDRESS}",
    )

    def check(self, key: str, root: Any) -> None:
        """A motion can be cut to a rectangle; by blocks, no log is written but the blocks' own."""
        if self.block is None:
            return
        if not root.kernel.is_motion:
            raise refuse(f"{key}.block", self.block, f"null with kernel={root.kernel.name}")
        if not root.learns:
            return
        if [*root.log] not in ([], ["csv"]):
            raise refuse(
                "log", listed(root.log), f"[csv] with {key}.block: each block has a log of its own"
            )
        if root.init_from is not None:
            raise refuse("init_from", root.init_from, f"null with {key}.block")

    def ignored(self, root: Any) -> Reasons:
        """Without blocks there is nothing to know of, or to share out."""
        why = f"without partition.block, the whole grid being {'learned' if root.learns else 'planned'} at once"
        return {name: why for name in vars(self) if name != "block"} if self.block is None else {}


class SweptPartitionConfig(PartitionConfig):
    """Blocks that plan, and the rounds over the whole grid after them."""

    sweeps: int | None = option(
        "rounds of exchange over the whole grid after the blocks (solver=optimal), all values known, until none grows; "
        "null = at most 10 with the default halo, none with a halo of its own",
        unit="rounds",
        ge=0,
        le=1000,
    )
