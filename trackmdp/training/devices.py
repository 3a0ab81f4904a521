"""The machine: its devices by their names, the memory that a run needs of it, and its description beside a figure."""

from __future__ import annotations

import ctypes
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch

from trackmdp.config import TrainConfig
from trackmdp.config.options import nodes
from trackmdp.errors import UserError
from trackmdp.machine import free_bytes, gib
from trackmdp.sensing.task import Task


def check_memory(cfg: TrainConfig, task: Task, device: torch.device) -> str:
    """One line about the memory that the run needs and the memory free on `device`.

    Raises:
        UserError: it cannot fit; the option that takes most of it is named.
    """
    parts, gpu = needs(cfg, task), device.type == "cuda"
    free = torch.cuda.mem_get_info(device)[0] if gpu else free_bytes()
    total = sum(parts.values())
    key = max(parts, key=lambda name: parts[name])
    if total > free:
        value = attrgetter(key)(cfg)
        raise UserError(f"{key}={value}: needs about {gib(total)}, {gib(free)} are available")
    return f"memory: about {gib(total)} of {gib(free)}, most by {key}"


def needs(cfg: TrainConfig, task: Task) -> dict[str, int]:
    """Bytes of the replay buffer, of collected batches and of networks, by the option that they grow with."""
    parts: dict[str, int] = {}
    for _, node in nodes(cfg):
        parts |= node.needs(task, cfg)
    return parts


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


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")),
        platform.machine(),
    )


@contextmanager
def reused_memory() -> Iterator[None]:
    """Inside, large arrays are allocated where freed ones were, if the C library is glibc.

    Else glibc gives each array above 32 MB back to the system when it is freed, and the next one is mapped anew, page
    by page: three fifths of the time to collect a batch on 64 x 64 cells, which is 200 MB.
    A whole run there takes .59 of the CPU time; the largest memory in use is up to 16 % more, by gaps between arrays.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):
        yield
        return
    # M_TRIM_THRESHOLD and M_MMAP_MAX, see mallopt(3).
    library.mallopt(-1, 2**30)
    library.mallopt(-4, 0)
    try:
        yield
    finally:
        # Each as glibc sets it by itself after an array of 32 MB, M_MMAP_THRESHOLD as well.
        library.mallopt(-1, 2**26)
        library.mallopt(-3, 2**25)
        library.mallopt(-4, 2**16)
        library.malloc_trim(0)
