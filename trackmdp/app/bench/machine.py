"""Rates and CPU time of repeated work, measured for a given time."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch


def rate(work: Callable[[], int], seconds: float, device: torch.device) -> dict[str, float]:
    """Call `work` for at least `seconds` after a warm-up call; units per wall second and CPU microseconds per unit.

    The call is repeated in five blocks and the fastest counts: other load on the machine only ever slows a block down.
    """
    # The first call compiles, allocates and fills caches.
    work()
    best = {"per_second": 0.0, "cpu_us_each": float("inf")}
    for _ in range(5):
        done, cpu, wall = 0, time.process_time(), time.perf_counter()
        while time.perf_counter() - wall < seconds / 5:
            done += work()
            # Work on a GPU is only queued by the call; without waiting, the queue would be timed.
            if device.type == "cuda":
                torch.cuda.synchronize(device)
        spent, used = time.perf_counter() - wall, time.process_time() - cpu
        # Each by itself: the block with the best wall time need not be the one with the least CPU time.
        best["per_second"] = max(best["per_second"], done / spent)
        best["cpu_us_each"] = min(best["cpu_us_each"], 1e6 * used / done)
    return best
