"""Logging episodes: what a step costs in time and in bytes, to write and to read."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench.machine import rate
from trackmdp.config import BenchmarkConfig, to_yaml
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.record import Acting, Chains, RandomSets, record
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.seeding import derive
from trackmdp.solvers import qmdp
from trackmdp.world.model import World

__all__ = ["log_speed"]

_EPISODES = 100


def log_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[dict[str, Any]]:
    """Steps per second of recording, writing, reading and decoding; bytes of a step; belief and policy are in it."""
    policies: dict[str, Acting] = {
        "qmdp": Chains(qmdp.solve(world).dense()),
        "random_k": RandomSets(world.num_cells, 5),
    }
    seeds = [derive(cfg.seed, "benchmark", number) for number in range(_EPISODES)]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episodes.mcap"
        for name, acting in policies.items():

            def simulate(acting: Acting = acting) -> int:
                return sum(map(len, record(world, acting, seeds)))

            episodes = list(record(world, acting, seeds))

            def write(acting: Acting = acting, episodes: list[Episode] = episodes) -> int:
                return _write(file, cfg, world, acting, episodes)

            def read() -> int:
                with EpisodeReader(file) as reader:
                    return sum(map(len, reader.episodes()))

            steps = write()
            size = file.stat().st_size / steps
            for what, work in (("record", simulate), ("write", write), ("read", read)):
                figures = rate(work, cfg.seconds, device)
                rows.append({"part": "log", "policy": name, "what": what, "bytes_per_step": size, **figures})
    return rows


def _write(file: Path, cfg: BenchmarkConfig, world: World, acting: Acting, episodes: list[Episode]) -> int:
    writer = EpisodeWriter(file, world, facts={"seed": str(cfg.seed)}, config=to_yaml(cfg))
    writer.add_policy(acting.facts, getattr(acting, "chains", None))
    for episode in episodes:
        writer.add(episode)
    writer.finish()
    return sum(map(len, episodes))
