"""One grid planned by blocks: what the hand-off between sub-grids loses, and what several workers gain."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import torch

from trackmdp.config import BenchmarkConfig
from trackmdp.config.compose import compose
from trackmdp.solvers.partition import default_halo
from trackmdp.solvers.solution import bracketed
from trackmdp.solvers.solve import by_blocks, run_solver
from trackmdp.solvers.workers import Crew, Piece, Result, crew
from trackmdp.world.model import World

_COSTS, _T_MAX = (0.16, 0.22), (1, 2)


def handoff(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per price, T_max, block and halo: what the policy of the blocks lacks to that of the whole grid.

    The kernel and D are those of the config, so that all rows are about one target. A row for each halo shows what the
    blocks' own plans lose; the last one, of the default halo, what is left after the sweeps over the whole grid.
    """
    for cost, t_max in product(_COSTS, _T_MAX):
        here = replace(world, cost=np.full(world.num_cells, cost), t_max=t_max)
        whole = run_solver(here, compose("solve").solver)
        for block, halo in product(cfg.blocks, [*sorted({*cfg.halos, default_halo(here)}), None]):
            options = compose("solve", {"partition.block": block, "partition.halo": halo})
            started = time.process_time()
            found = run_solver(here, options.solver, None, options.partition)
            yield {
                "c": cost,
                "T_max": t_max,
                "block": block,
                "halo": default_halo(here) if halo is None else halo,
                "sweeps": halo is None,
                "loss_per_step": (whole.lower - found.lower) / whole.evaluation.expected_length,
                "gap_per_step": (found.upper - found.lower) / whole.evaluation.expected_length,
                "cpu_seconds": time.process_time() - started,
            }


@dataclass(frozen=True)
class _Timed:
    """Work that also tells by which process it was done, and the CPU seconds of that process so far."""

    work: Callable[[Any], Any]

    def __call__(self, job: Any) -> tuple[int, float, Any]:
        found = self.work(job)
        # Not of this job alone: what a worker takes to start and to unpack its jobs counts as well.
        return os.getpid(), time.process_time(), found


@dataclass
class _Watched:
    """A crew whose workers' CPU seconds are known, by process."""

    run: Crew
    seconds: dict[int, float] = field(default_factory=dict)

    def __call__(self, work: Callable[[Piece], Result], jobs: Sequence[Piece]) -> list[Result]:
        done = self.run(_Timed(work), jobs)
        for process, seconds, _ in done:
            self.seconds[process] = max(seconds, self.seconds.get(process, 0.0))
        return [found for *_, found in done]


def workers(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per number in `workers`, in that order, so that 1, 2, 1, 2 takes turns; 1 comes first.

    The grid is solved by blocks of `blocks[0]` in processes, or on the Ray cluster `cluster`, and the whole is valued;
    the clock starts when the cluster stands. `speed_up` is to the last row of one worker. `allowed` depends on no other
    load: all CPU seconds, over those of this process, whose work is not shared, and of the busiest worker.
    """
    alone = None
    for number in cfg.workers:
        options = compose("solve", {"partition.block": cfg.blocks[0], "partition.workers": number})
        with crew(number, cfg.cluster, "cluster") as run:
            watched, used, began = _Watched(run), time.process_time(), time.perf_counter()
            found = bracketed(world, by_blocks(world, options.solver, options.partition, watched), 0.0)
            wall, driver = time.perf_counter() - began, time.process_time() - used
        # One worker without a cluster is this process.
        if os.getpid() in watched.seconds:
            watched.seconds = {os.getpid(): driver}
            driver = 0.0
        alone = wall if number == 1 else alone
        total = driver + sum(watched.seconds.values())
        yield {
            "workers": number,
            "N": world.rows,
            "wall_seconds": wall,
            "driver_seconds": driver,
            "worker_seconds": " + ".join(f"{seconds:.3g}" for seconds in watched.seconds.values()),
            "speed_up": alone / wall if alone else None,
            "allowed": total / (driver + max(watched.seconds.values())),
            "aihtr": found.lower,
        }
