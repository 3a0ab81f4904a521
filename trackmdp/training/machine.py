"""The machine: its devices by their names, and what is told of it beside a figure."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from trackmdp.errors import UserError


def make_device(name: str, key: str = "device") -> torch.device:
    """The torch device called `name`; `auto` is the first GPU where there is one.

    Raises:
        UserError: there is no such device here.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda:0" if count else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:  # an index that is no C integer
        raise UserError(f"{key}={name}: no such device here ({count} CUDA devices found); use cpu or auto") from None
    if device.type == "cuda" and (device.index or 0) >= count:
        raise UserError(f"{key}={name}: no such device here ({count} CUDA devices found); use cpu or auto")
    return device


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
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
