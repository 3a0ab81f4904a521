"""Time and memory by grid size: solving, training and stepping, each in a process of its own."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench.process import measured, typed
from trackmdp.config import BenchmarkConfig
from trackmdp.world.model import World

__all__ = ["size"]

COSTS = (0.16, 0.22)
"""Prices: at the first beliefs hardly spread, at the second all probabilities lie below c/r."""
WINDOW, ENVS = 2, 1024


def size(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per size and kind of work: seconds and peak memory of the whole process, the start of Python included.

    Rows of the environment time its steps alone, so they have steps per second and the memory. A run that is refused,
    as where it asks for more memory than there is, leaves its row without figures.
    """
    own = [f"threads={cfg.threads}", f"device={device}", f"seed={cfg.seed}"]
    for n in cfg.sizes:
        at = [*typed("kernel", "grid.t_max"), f"grid.size={n}"]
        for cost in COSTS:
            yield _row(
                n, f"solve, c = {cost:g}", "regret_per_step", "solution.json", "solve", *at, f"cost.sensor={cost}"
            )
        yield _row(n, "train hindsight", "regret_per_step", "summary.json", "train", *at, *own)
        # A benchmark within the benchmark, so that each size has a process, and a peak memory, of its own.
        steps = ["benchmark", "part=env", f"batch_sizes=[{ENVS}]", f"seconds={cfg.seconds}", *at, *own]
        yield _row(n, f"env, B = {ENVS}", "per_second", "benchmark.json", *steps)
        window = f"env, B = {ENVS}, window {WINDOW}"
        yield _row(n, window, "per_second", "benchmark.json", *steps, f"grid.window={WINDOW}")


def _row(n: int, what: str, figure: str, file: str, *words: str) -> dict[str, Any]:
    row: dict[str, Any] = {"part": "size", "N": n, "what": what, "wall_seconds": None, "cpu_seconds": None}
    row |= {"peak_mib": None, "regret_per_step": None, "per_second": None}
    with tempfile.TemporaryDirectory() as folder:
        try:
            usage = asdict(measured(*words, "quiet=true", f"hydra.run.dir={folder}/run"))
        # Refused for lack of memory: that is a result as well, and the larger sizes are still of interest.
        except subprocess.CalledProcessError:
            return row
        result = json.loads(Path(folder, "run", file).read_text())
    if "rows" in result:  # a rate: of the process only its memory is of interest
        result, usage = result["rows"][0], {"peak_mib": usage["peak_mib"]}
    return row | usage | {figure: result[figure]}
