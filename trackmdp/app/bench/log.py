"""Time and bytes per step of logging episodes, written and read."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import torch

from trackmdp.app.bench.process import rate
from trackmdp.config import BenchmarkConfig, to_yaml
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.solvers import qmdp
from trackmdp.world.model import World

_EPISODES = 100


def log_speed(cfg: BenchmarkConfig, world: World, device: torch.device) -> list[dict[str, Any]]:
    """Steps per second of recording, writing, reading and decoding; bytes of a step; belief and policy are in it."""
    policies = {"qmdp": as_policy(world, qmdp.solve(world)), "random_k": Policy.random_k(world, 5)}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "episodes.mcap"
        for name, policy in policies.items():

            def record(policy: Policy = policy) -> int:
                return sum(map(len, simulate(world, policy, _EPISODES, seed=cfg.seed).complete()))

            # Simulated once, outside of what is timed: "write" is to measure the log alone.
            episodes = list(simulate(world, policy, _EPISODES, seed=cfg.seed).complete())

            def write(policy: Policy = policy, episodes: list[Episode] = episodes) -> int:
                return _write(file, cfg, world, policy, episodes)

            def read() -> int:
                with EpisodeReader(file) as reader:
                    return sum(map(len, reader.episodes()))

            # The file has to be there before it can be measured and read.
            steps = write()
            size = file.stat().st_size / steps
            for what, work in (("record", record), ("write", write), ("read", read)):
                figures = rate(work, cfg.seconds, device)
                rows.append({"part": "log", "policy": name, "what": what, "bytes_per_step": size, **figures})
    return rows


def _write(file: Path, cfg: BenchmarkConfig, world: World, policy: Policy, episodes: list[Episode]) -> int:
    writer = EpisodeWriter.of(file, world, facts={"seed": str(cfg.seed)}, config=to_yaml(cfg))
    writer.add_policy({"label": "benchmark"}, policy)
    for episode in episodes:
        writer.add(episode)
    writer.finish()
    return sum(map(len, episodes))
