"""How good, how soon: whole training runs by the command a user types, in processes of their own."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig

from trackmdp.config import BenchmarkConfig
from trackmdp.world.model import World

__all__ = ["quality"]

THRESHOLDS = (0.05, 0.02, 0.005)


def quality(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[dict[str, Any]]:  # noqa: ARG001
    """One row per algorithm and seed: the final regret per step, and when it was below each threshold for good.

    `wall_seconds` runs from pressing Enter to the end of the process, the solver included; the `below_` columns count
    seconds of collecting, learning and evaluating.
    """
    typed = [word for word in HydraConfig.get().overrides.task if word.split("=")[0].split(".")[0] in _WORLD]
    typed.append(f"threads={cfg.threads}")
    return [_trained(algo, seed, typed, device) for algo in cfg.algos for seed in cfg.seeds]


_WORLD = ("grid", "kernel", "cost")


def _trained(algo: str, seed: int, overrides: list[str], device: torch.device) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        words = [f"algo={algo}", f"seed={seed}", f"device={device}", "quiet=true", f"hydra.run.dir={folder}/run"]
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", "trackmdp.cli", "train", *words, *overrides], check=True)
        wall = time.perf_counter() - started
        summary = json.loads(Path(folder, "run", "summary.json").read_text())
        with Path(folder, "run", "metrics.csv").open() as stream:
            curve = [row for row in csv.DictReader(stream) if row["regret_per_step"]]
    reached = {f"below_{threshold:g}": _settled(curve, threshold) for threshold in THRESHOLDS}
    return {
        "part": "quality",
        "algo": algo,
        "seed": seed,
        "frames": summary["frames"],
        "regret_per_step": summary["regret_per_step"],
        **reached,
        "cpu_seconds": summary["cpu_seconds"],
        "wall_seconds": wall,
    }


def _settled(curve: list[dict[str, str]], threshold: float) -> float | None:
    """Seconds after which the regret stays below `threshold`; None if it never does."""
    since = None
    for row in curve:
        if float(row["regret_per_step"]) > threshold:
            since = None
        elif since is None:
            since = float(row["seconds"])
    return since
