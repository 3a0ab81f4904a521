"""What a run needs of the memory, estimated before anything large is made."""

from __future__ import annotations

from pathlib import Path

import torch

from trackmdp.config import TrainConfig
from trackmdp.config.options import nodes
from trackmdp.errors import UserError
from trackmdp.machine import free_bytes, gib
from trackmdp.world.model import Task


def check_memory(cfg: TrainConfig, task: Task, device: torch.device) -> str:
    """One line about the memory that the run needs and what there is on `device`.

    Raises:
        UserError: it cannot fit; the option that takes most of it is named.
    """
    parts, free = needs(cfg, task), available_bytes(device)
    total = sum(parts.values())
    key = max(parts, key=lambda name: parts[name])
    if total > free:
        value = getattr(getattr(cfg, key.split(".")[0]), key.split(".")[1])
        raise UserError(f"{key}={value}: needs about {gib(total)}, {gib(free)} are available")
    return f"memory: about {gib(total)} of {gib(free)}, most by {key}"


def needs(cfg: TrainConfig, task: Task) -> dict[str, int]:
    """Bytes of the replay buffer, of collected batches and of networks, by the option that they grow with."""
    parts: dict[str, int] = {}
    for _, node in nodes(cfg):
        parts |= node.needs(task, cfg)
    return parts


def available_bytes(device: torch.device, root: Path = Path("/")) -> int:
    """Bytes that can still be had on `device`; `root` is where the system's files are (`machine.free_bytes`)."""
    return int(torch.cuda.mem_get_info(device)[0]) if device.type == "cuda" else free_bytes(root)
