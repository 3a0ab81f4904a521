"""Peak memory of training, beside the estimate that is checked before a run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import torch

from trackmdp.app.bench.process import timed_training
from trackmdp.config import BenchmarkConfig
from trackmdp.config.compose import compose
from trackmdp.training.memory import needs
from trackmdp.world.make import build_world
from trackmdp.world.model import World

SIZES, FRAMES = (5, 10, 20), 300_000


def memory(cfg: BenchmarkConfig, world: World, device: torch.device) -> Iterator[dict[str, Any]]:  # noqa: ARG001
    """One row per algorithm and grid size: peak of the whole process, Python and torch included, of 300 k frames."""
    for algo, size in itertools.product(cfg.algos, SIZES):
        # Without the solver: its memory is not what `needs` expects of training.
        options = {"algo": algo, "grid.size": size, "collector.total_frames": FRAMES, "optimal.enabled": False}
        train, words = compose("train", options), [f"{key}={value}" for key, value in options.items()]
        # What the check before a run adds up, without Python and torch, which `peak_mib` includes.
        expected = sum(needs(train, build_world(train).task).values())
        _, usage = timed_training(*words, f"threads={cfg.threads}", f"device={device}")
        yield {"part": "memory", "algo": algo, "N": size, "expected_mib": expected / 2**20, "peak_mib": usage.peak_mib}
