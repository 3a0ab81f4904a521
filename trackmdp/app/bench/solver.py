"""What the certified optimum costs: time and memory by grid size and T_max, each in a process of its own."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench.process import measured
from trackmdp.config import BenchmarkConfig
from trackmdp.world.model import World

__all__ = ["SIZES", "T_MAX", "solver"]

SIZES = (5, 10, 20, 30)
T_MAX = (0, 1, 2, 3, 4, 5)
PAIRS = ((5, 0.16), (5, 0.22))
TIME_LIMIT = 60


def solver(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[dict[str, Any]]:  # noqa: ARG001
    """One row per support size, cost, grid size and T_max: is it certified, how wide is the bracket, at what price."""
    return list(_rows())


def _rows() -> Iterator[dict[str, Any]]:
    for support, cost in PAIRS:
        for size in SIZES:
            for t_max in T_MAX:
                yield _solved(support, cost, size, t_max)


def _solved(support: int, cost: float, size: int, t_max: int) -> dict[str, Any]:
    """One solve, as typed; `cpu_seconds` and `peak_mib` are of the whole process, the start of Python included."""
    world = [f"kernel.support_size={support}", f"cost.sensor={cost}", f"grid.size={size}", f"grid.t_max={t_max}"]
    with tempfile.TemporaryDirectory() as folder:
        words = [*world, f"solver.time_limit={TIME_LIMIT}", "quiet=true", f"hydra.run.dir={folder}/run"]
        usage = measured("solve", *words)
        solution = json.loads(Path(folder, "run", "solution.json").read_text())
    return {
        "part": "solver",
        "Z": support,
        "c": cost,
        "N": size,
        "T_max": t_max,
        "certified": solution["certified"],
        "gap_per_step": solution["regret_per_step"],
        "nodes": solution["nodes"],
        "solve_seconds": solution["seconds"],
        "cpu_seconds": usage.cpu_seconds,
        "peak_mib": usage.peak_mib,
    }
