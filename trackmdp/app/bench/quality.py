"""How good, how soon: whole training runs by the command a user types, in processes of their own."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig

from trackmdp.app.bench.process import Trained, trained
from trackmdp.config import BenchmarkConfig
from trackmdp.paper.worlds import COSTS, SUPPORTS
from trackmdp.world.model import World

__all__ = ["growth", "histogram", "pairs", "quality"]

THRESHOLDS = (0.05, 0.02, 0.005)
T_MAX = (0, 1, 2, 3, 5)
SIZES, CHOICES = (5, 10, 20, 30, 40), (0, 1, 2, 3, 4, 5)
_WORLD = ("grid", "kernel", "cost")
_BINS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05)

Row = dict[str, Any]


def quality(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[Row]:  # noqa: ARG001
    """One row per algorithm and seed: the final regret per step, and when it was below each threshold for good.

    `wall_seconds` runs from pressing Enter to the end of the process, the solver included; the `below_` columns count
    seconds of collecting, learning and evaluating.
    """
    words = [*_typed(*_WORLD), *_common(cfg, device)]
    for algo, seed in itertools.product(cfg.algos, cfg.seeds):
        run = trained(f"algo={algo}", f"seed={seed}", *words)
        yield {"part": "quality", "algo": algo, "seed": seed, **_below(run), **run.figures()}


def pairs(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[Row]:  # noqa: ARG001
    """One row per algorithm, T_max and pair of the paper (Section VII): regret per seed, and the longest run.

    The regret is to the upper end of the optimum's bracket, whose width per step stands beside it.
    """
    words = [*_typed("kernel.border", "grid.size"), *_common(cfg, device)]
    for algo, t_max, support, cost in itertools.product(cfg.algos, T_MAX, SUPPORTS, COSTS):
        pair = [f"kernel.support_size={support}", f"cost.sensor={cost}", f"grid.t_max={t_max}"]
        runs = [trained(f"algo={algo}", f"seed={seed}", *pair, *words) for seed in cfg.seeds]
        yield {"part": "pairs", "algo": algo, "T_max": t_max, "Z": support, "c": cost, **_over(runs)}


def growth(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[Row]:  # noqa: ARG001
    """One row per algorithm and grid size, and per T_max: regret, time and memory as the problem grows."""
    words = [*_typed("kernel", "cost"), *_common(cfg, device), f"seed={cfg.seeds[0]}"]
    worlds = [(size, cfg.grid.t_max) for size in SIZES] + [(cfg.grid.size, t_max) for t_max in CHOICES]
    for algo, (size, t_max) in itertools.product(cfg.algos, dict.fromkeys(worlds)):
        run = trained(f"algo={algo}", f"grid.size={size}", f"grid.t_max={t_max}", *words)
        yield {"part": "growth", "algo": algo, "N": size, "T_max": t_max, **_gap(run), **run.figures()}


def histogram(rows: list[Row]) -> list[tuple[str, str, int]]:
    """Algorithm, range of regrets per step, and how many of the runs in `rows` ended in it."""
    counted = []
    for algo in dict.fromkeys(row["algo"] for row in rows):
        regrets = [row["regret_per_step"] for row in rows if row["algo"] == algo]
        for low, high in zip((float("-inf"), *_BINS), (*_BINS, float("inf")), strict=True):
            text = f"over {low:g}" if high == float("inf") else f"up to {high:g}"
            counted.append((algo, text, sum(low < regret <= high for regret in regrets)))
    return counted


def _typed(*keys: str) -> list[str]:
    """The words typed for this benchmark that are about one of `keys`."""
    words = HydraConfig.get().overrides.task
    return [word for word in words if any(word.split("=")[0].startswith(key) for key in keys)]


def _common(cfg: BenchmarkConfig, device: torch.device) -> list[str]:
    return [f"threads={cfg.threads}", f"device={device}"]


def _below(run: Trained) -> dict[str, float | None]:
    return {f"below_{threshold:g}": run.settled(threshold) for threshold in THRESHOLDS}


def _gap(run: Trained) -> dict[str, float]:
    """How much of the regret may not be: the width of the bracket that the optimum is proved to lie in, per step."""
    summary = run.summary
    return {
        "bracket": (summary["optimal"]["upper"] - summary["optimal"]["lower"]) / summary["policy"]["expected_length"]
    }


def _over(runs: list[Trained]) -> dict[str, Any]:
    regrets = [run.summary["regret_per_step"] for run in runs]
    return {
        "worst_regret": max(regrets),
        "bracket": max(_gap(run)["bracket"] for run in runs),
        "wall_seconds": max(run.usage.wall_seconds for run in runs),
        "cpu_seconds": max(run.usage.cpu_seconds for run in runs),
        "regrets": dict(enumerate(regrets)),
    }
