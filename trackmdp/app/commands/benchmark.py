"""`benchmark`: measure what this machine takes: time and memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench import blocks, peers, size, speed, spreading
from trackmdp.config import BenchmarkConfig
from trackmdp.durable import write_json
from trackmdp.training.display import make_console, table
from trackmdp.training.machine import machine, make_device
from trackmdp.world.model import World
from trackmdp.world.tracks import Problem

PARTS: dict[str, Callable[[BenchmarkConfig, World, torch.device], Iterable[dict[str, Any]]]] = {
    "env": speed.env_speed,
    "collector": speed.collector_speed,
    "train": speed.train_speed,
    "size": size.size,
    "handoff": blocks.handoff,
    "memory": size.memory,
    "peers": peers.peers,
    "log": speed.log_speed,
    "regret": spreading.regret,
    "bracket": spreading.bracket,
    "workers": blocks.workers,
}


def run(cfg: BenchmarkConfig, folder: Path, world: Problem) -> None:
    """Measure `cfg.part` and write `benchmark.json` to `folder`, row by row as they come."""
    console = make_console(cfg.quiet)
    torch.set_num_threads(cfg.threads)
    device = make_device(cfg.device)
    where = machine()
    rows: list[dict[str, Any]] = []
    assert isinstance(world, World)  # recorded tracks are refused
    with console.status(f"measuring {cfg.part}") as status:
        for row in PARTS[cfg.part](cfg, world, device):
            rows.append({"part": cfg.part} | row)
            write_json(folder / "benchmark.json", {"machine": where, "rows": rows})
            status.update(f"measuring {cfg.part}: {len(rows)} rows so far, in {folder}")
    shown = [key for key in rows[0] if not isinstance(rows[0][key], dict)]
    title = f"{where['processor']}, {where['cores']} cores, {cfg.threads} torch threads, {device}"
    console.print(table(title, shown, [[_text(row[key]) for key in shown] for row in rows]))
    console.print(f"results in {folder}")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    return "–" if value is None else str(value)
