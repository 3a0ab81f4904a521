"""The learned kernel on the paper's twelve pairs: regret and price of learning, all sensors on and with chosen sets."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from trackmdp.config import BenchmarkConfig, PaperCostConfig, RandomSupportConfig, load_run
from trackmdp.paper.worlds import COSTS, SUPPORTS
from trackmdp.world.model import World

__all__ = ["learned_kernel"]

VARIANTS = (("all", 30_000), ("all", 100_000), ("chosen", 100_000))


def learned_kernel(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per variant, support size and cost: regrets over the seeds, price of learning, one learning curve."""
    for sensing, frames in VARIANTS:
        yield from _variant(cfg.seeds, sensing, frames)


def _variant(seeds: list[int], sensing: str, frames: int) -> list[dict[str, Any]]:
    words = [
        "algo=learned_kernel",
        f"algo.sensing={sensing}",
        f"collector.total_frames={frames}",
        "evaluation.every=1",
        "quiet=true",
        f"seed={','.join(map(str, seeds))}",
        f"kernel.support_size={','.join(map(str, SUPPORTS))}",
        f"cost.sensor={','.join(map(str, COSTS))}",
    ]
    with tempfile.TemporaryDirectory() as folder:
        line = ["train", "-m", *words, f"hydra.sweep.dir={folder}"]
        subprocess.run([sys.executable, "-m", "trackmdp.app.cli", *line], check=True)
        runs = [_run(Path(file).parent) for file in sorted(Path(folder).glob("*/summary.json"))]
    pairs = [(support, cost) for support in SUPPORTS for cost in COSTS]
    return [_row(sensing, pair, [run for run in runs if run["pair"] == pair]) for pair in pairs]


def _run(folder: Path) -> dict[str, Any]:
    summary = json.loads((folder / "summary.json").read_text())
    cfg = load_run(str(folder))
    assert isinstance(cfg.kernel, RandomSupportConfig)
    assert isinstance(cfg.cost, PaperCostConfig)
    with (folder / "metrics.csv").open() as stream:
        curve = list(csv.DictReader(stream))
    return {
        "pair": (cfg.kernel.support_size, cfg.cost.sensor),
        "frames": summary["frames"],
        "regret": summary["regret_per_step"],
        "cpu_seconds": summary["cpu_seconds"],
        "sensors_per_frame": float(curve[-1]["sensors_per_frame"]),
        "reward_per_frame": summary["while_collecting"]["reward_per_frame"],
        "curve": {"frames": [int(row["frames"]) for row in curve], "regret": [_number(row) for row in curve]},
    }


def _number(row: dict[str, str]) -> float | None:
    return float(row["regret_per_step"]) if row["regret_per_step"] else None


def _row(sensing: str, pair: tuple[int, float], runs: list[dict[str, Any]]) -> dict[str, Any]:
    def mean(key: str) -> float:
        return float(sum(run[key] for run in runs)) / len(runs)

    return {
        "part": "learned_kernel",
        "sensing": sensing,
        "frames": runs[0]["frames"],
        "Z": pair[0],
        "c": pair[1],
        "mean_regret": mean("regret"),
        "worst_regret": max(run["regret"] for run in runs),
        "sensors_per_frame": mean("sensors_per_frame"),
        "reward_per_frame": mean("reward_per_frame"),
        "cpu_seconds": mean("cpu_seconds"),
        "curve": runs[0]["curve"],
    }
