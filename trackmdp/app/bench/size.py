"""Time and memory by grid size: solving, training and stepping, each in a process of its own; and memory expected."""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench.process import measured, timed_training, typed
from trackmdp.config import BenchmarkConfig
from trackmdp.config.compose import compose
from trackmdp.training.machine import needs
from trackmdp.world.make import build_world
from trackmdp.world.model import World

_COSTS = (0.16, 0.22)
"""Prices: at the first beliefs hardly spread, at the second all probabilities lie below c/r."""
WINDOW, ENVS = 2, 1024
RESULTS = {"solve": "solution.json", "train": "summary.json", "benchmark": "benchmark.json"}
MEMORY_SIZES, MEMORY_FRAMES = (5, 10, 20), 300_000


def size(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per size and kind of work: seconds and peak memory of the whole process, the start of Python included.

    Rows of the environment time its steps alone, so they have steps per second and the memory. A run that is refused,
    as where it asks for more memory than there is, leaves its row without figures. Exponents say how CPU time and
    memory have grown with M since the size before.
    """
    previous: dict[str, dict[str, Any]] = {}
    for row in _rows(cfg, device):
        yield row | _growth(previous.get(row["what"]), row)
        previous[row["what"]] = row


def _rows(cfg: BenchmarkConfig, device: torch.device) -> Iterator[dict[str, Any]]:
    own = [f"threads={cfg.threads}", f"device={device}", f"seed={cfg.seed}"]
    for n in cfg.sizes:
        at = [*typed("kernel", "grid.t_max", "cost.safe"), f"grid.size={n}"]
        for cost in _COSTS if "solve" in cfg.work else ():
            yield _row(n, f"solve, c = {cost:g}", "solve", *at, f"cost.sensor={cost}")
        if "train" in cfg.work:
            # Actions over all cells would make a budget per cell one of M² numbers.
            learner = [f"algo={cfg.learner}", f"grid.window={WINDOW}"]
            yield _row(n, f"train {cfg.learner}, window {WINDOW}", "train", *at, *own, *learner)
        if "env" in cfg.work:
            # A benchmark within the benchmark, so that each size has a process, and a peak memory, of its own.
            steps = ["part=env", f"batch_sizes=[{ENVS}]", f"seconds={cfg.seconds}", *at, *own]
            yield _row(n, f"env, B = {ENVS}", "benchmark", *steps)
            yield _row(n, f"env, B = {ENVS}, window {WINDOW}", "benchmark", *steps, f"grid.window={WINDOW}")


def _growth(before: dict[str, Any] | None, row: dict[str, Any]) -> dict[str, float | None]:
    """Exponents of CPU time and memory in M = N², from the row of the size before."""
    found: dict[str, float | None] = {}
    for name, key in (("cpu_exponent", "cpu_seconds"), ("memory_exponent", "peak_mib")):
        found[name] = None
        if before and before[key] and row[key] and before["N"] != row["N"]:
            # 16 s at N = 512 and 61 s at N = 1000: log(61 / 16) / log(1000² / 512²) = 1.0
            found[name] = math.log(row[key] / before[key]) / (2 * math.log(row["N"] / before["N"]))
    return found


def _row(n: int, what: str, command: str, *words: str) -> dict[str, Any]:
    row: dict[str, Any] = {"N": n, "what": what, "wall_seconds": None, "cpu_seconds": None}
    row |= {"peak_mib": None, "regret_per_step": None, "per_second": None}
    with tempfile.TemporaryDirectory() as folder:
        try:
            usage = asdict(measured(command, *words, "quiet=true", f"hydra.run.dir={folder}/run"))
        # Refused for lack of memory: that is a result as well, and the larger sizes are still of interest.
        except subprocess.CalledProcessError:
            return row
        result = json.loads(Path(folder, "run", RESULTS[command]).read_text())
    if "rows" in result:  # a rate: of the process only its memory is of interest
        return row | {"peak_mib": usage["peak_mib"], "per_second": result["rows"][0]["per_second"]}
    return row | usage | {"regret_per_step": result["regret_per_step"]}


def memory(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per algorithm and grid size: peak of the whole process, Python and torch included, of 300 k frames."""
    for algo, size in itertools.product(cfg.algos, MEMORY_SIZES):
        # Without the solver: its memory is not what `needs` expects of training.
        options = {"algo": algo, "grid.size": size, "collector.total_frames": MEMORY_FRAMES, "optimal.enabled": False}
        train, words = compose("train", options), [f"{key}={value}" for key, value in options.items()]
        # What the check before a run adds up, without Python and torch, which `peak_mib` includes.
        expected = sum(needs(train, build_world(train).task).values())
        _, usage = timed_training(*words, f"threads={cfg.threads}", f"device={device}")
        yield {"algo": algo, "N": size, "expected_mib": expected / 2**20, "peak_mib": usage.peak_mib}
