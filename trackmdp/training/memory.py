"""What a run needs of the memory, estimated before anything large is made."""

from __future__ import annotations

from pathlib import Path

import torch

from trackmdp.config import TrainConfig
from trackmdp.config.options import nodes
from trackmdp.errors import UserError
from trackmdp.world.model import Task

__all__ = ["available_bytes", "check_memory", "needs"]

_GIB = 2**30
_CGROUPS = (
    ("memory.max", "memory.current", "inactive_file"),
    ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
)


def check_memory(cfg: TrainConfig, task: Task, device: torch.device) -> str:
    """One line about the memory that the run needs and what there is on `device`.

    Raises:
        UserError: it cannot fit; the option that takes most of it is named.
    """
    parts, free = needs(cfg, task), available_bytes(device)
    total = sum(parts.values())
    if total > free:
        key = max(parts, key=lambda name: parts[name])
        value = getattr(getattr(cfg, key.split(".")[0]), key.split(".")[1])
        raise UserError(f"{key}={value}: needs about {_gib(total)}, {_gib(free)} are available")
    shares = ", ".join(f"{key} {_gib(size)}" for key, size in parts.items())
    return f"memory: about {_gib(total)} of {_gib(free)} ({shares})"


def needs(cfg: TrainConfig, task: Task) -> dict[str, int]:
    """Bytes of the replay buffer, of collected batches and of networks, by the option that they grow with."""
    parts: dict[str, int] = {}
    for _, node in nodes(cfg):
        parts |= node.needs(task, cfg)
    return parts


def available_bytes(device: torch.device, root: Path = Path("/")) -> int:
    """Bytes that can still be had on `device`: on the CPU what the system, and the job's own limit, leave.

    A system that does not say counts as unlimited. `root` is where its files are.
    """
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    free = [_entry(root / "proc/meminfo", "MemAvailable:", 1024)]
    for limit, used, cache in _CGROUPS:
        for folder in (root / "sys/fs/cgroup", root / "sys/fs/cgroup/memory"):
            # A job's own limit (version 2 of cgroups, then version 1) may be far below what the machine has; the
            # kernel kills whoever exceeds it without a message. Pages of files that are not in use count as used, but
            # are given back.
            most, now = _number(folder / limit), _number(folder / used)
            if most is not None and now is not None:
                free.append(most - now + (_entry(folder / "memory.stat", cache, 1) or 0))
    return min((each for each in free if each is not None), default=2**63)


def _entry(file: Path, name: str, unit: int) -> int | None:
    """The number after `name` in a file of lines."""
    try:
        rows = (line.split() for line in file.read_text().splitlines())
        return next((int(row[1]) * unit for row in rows if row and row[0] == name), None)
    except OSError:
        return None


def _number(file: Path) -> int | None:
    try:
        text = file.read_text().strip()
    except OSError:
        return None
    # Version 2 writes `max` where there is no limit.
    return int(text) if text.isdigit() else None


def _gib(size: int) -> str:
    return f"{size / _GIB:,.2f} GiB"
