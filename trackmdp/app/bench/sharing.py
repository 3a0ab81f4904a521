"""What several workers gain on one grid planned by blocks: wall time, and what the split of the work allows."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

from trackmdp.config import BenchmarkConfig
from trackmdp.config.compose import compose
from trackmdp.solvers.solution import bracketed
from trackmdp.solvers.solve import by_blocks
from trackmdp.solvers.workers import Crew, Job, Result, crew
from trackmdp.world.model import World


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

    def __call__(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
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
            "part": "workers",
            "workers": number,
            "N": world.rows,
            "wall_seconds": wall,
            "driver_seconds": driver,
            "worker_seconds": " + ".join(f"{seconds:.3g}" for seconds in watched.seconds.values()),
            "speed_up": alone / wall if alone else None,
            "allowed": total / (driver + max(watched.seconds.values())),
            "aihtr": found.lower,
        }
