"""Steps per second of simulating, writing and reading episodes, and bytes of a step in the log."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import trackmdp as tm
from benchmarks.clock import rate
from benchmarks.words import Row, world_of
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.writer import EpisodeWriter


def rows(
    words: Mapping[str, str], episodes: int = 100, seconds: float = 2.0, seed: int = 0
) -> Iterator[Row]:
    """One row for each policy and kind of work; the log holds beliefs and the policy."""
    world = world_of(words)
    policies = {"qmdp": tm.solve(world, "qmdp").policy, "random_k": tm.Policy.random_k(world, 5)}
    with tempfile.TemporaryDirectory() as folder:
        for name, policy in policies.items():
            timed = _Log(Path(folder, f"{name}.mcap"), world, policy, episodes, seed)
            bytes_per_step = timed.file.stat().st_size / timed.write()
            for work in (timed.record, timed.write, timed.read):
                figures = rate(work, seconds)
                what = work.__name__
                yield {"policy": name, "what": what, "bytes_per_step": bytes_per_step, **figures}


class _Log:
    """Some episodes of a policy, and their file, which exists from the start; each method returns its steps."""

    def __init__(
        self, file: Path, world: tm.World, policy: tm.Policy, episodes: int, seed: int
    ) -> None:
        self.file, self.world, self.policy, self.seed = file, world, policy, seed
        # Simulated once, outside of what is timed: `write` measures the log alone.
        self.episodes = list(tm.simulate(world, policy, episodes, seed=seed).complete())
        self.write()

    def record(self) -> int:
        made = tm.simulate(self.world, self.policy, len(self.episodes), seed=self.seed)
        return sum(map(len, made.complete()))

    def write(self) -> int:
        facts = {"seed": str(self.seed)}
        writer = EpisodeWriter.of(self.file, self.world, facts=facts, config="")
        writer.add_policy({"label": "benchmark"}, self.policy)
        for episode in self.episodes:
            writer.add(episode)
        writer.finish()
        return sum(map(len, self.episodes))

    def read(self) -> int:
        with EpisodeReader(self.file) as reader:
            return sum(map(len, reader.episodes()))
