"""What planning by blocks loses, by the width of the halo: the hand-off between sub-grids."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import torch

from trackmdp.config import BenchmarkConfig
from trackmdp.config.compose import compose
from trackmdp.solvers.partition import default_halo
from trackmdp.solvers.solve import run_solver
from trackmdp.world.model import World

COSTS, T_MAX = (0.16, 0.22), (1, 2)


def handoff(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per price, T_max, block and halo: what the policy of the blocks lacks to that of the whole grid.

    The kernel and D are those of the config, so that all rows are about one target. A row for each halo shows what the
    blocks' own plans lose; the last one, of the default halo, what is left after the sweeps over the whole grid.
    """
    for cost, t_max in product(COSTS, T_MAX):
        here = replace(world, cost=np.full(world.num_cells, cost), t_max=t_max)
        whole = run_solver(here, compose("solve").solver)
        for block, halo in product(cfg.blocks, [*sorted({*cfg.halos, default_halo(here)}), None]):
            options = compose("solve", {"partition.block": block, "partition.halo": halo})
            started = time.process_time()
            found = run_solver(here, options.solver, None, options.partition)
            yield {
                "part": "handoff",
                "c": cost,
                "T_max": t_max,
                "block": block,
                "halo": default_halo(here) if halo is None else halo,
                "sweeps": halo is None,
                "loss_per_step": (whole.lower - found.lower) / whole.evaluation.expected_length,
                "gap_per_step": (found.upper - found.lower) / whole.evaluation.expected_length,
                "cpu_seconds": time.process_time() - started,
            }
