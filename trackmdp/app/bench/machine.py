"""The machine a figure was measured on, and how long to measure."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

__all__ = ["machine", "rate"]


def machine() -> dict[str, Any]:
    """Processor, cores, memory and versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": version("torch"),
        "torchrl": version("torchrl"),
        "torch_threads": torch.get_num_threads(),
    }


def rate(work: Callable[[], int], seconds: float, device: torch.device) -> dict[str, float]:
    """Call `work` for at least `seconds` after a warm-up call; units per wall second and CPU microseconds per unit.

    The call is repeated in five blocks and the fastest counts: other load on the machine only ever slows a block down.
    """
    work()
    best = {"per_second": 0.0, "cpu_us_each": float("inf")}
    for _ in range(5):
        done, cpu, wall = 0, time.process_time(), time.perf_counter()
        while time.perf_counter() - wall < seconds / 5:
            done += work()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
        spent, used = time.perf_counter() - wall, time.process_time() - cpu
        best["per_second"] = max(best["per_second"], done / spent)
        best["cpu_us_each"] = min(best["cpu_us_each"], 1e6 * used / done)
    return best


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
