"""Small logs to read, damage and verify."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.helpers import limited, small_world
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.record import Acting, Chains, record
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.seeding import derive
from trackmdp.world.model import World

CONFIG = "quiet: true\n"
WORLD = small_world(4, t_max=2, exit_probability=0.04, seed=1)


def policy(world: World = WORLD, seed: int = 5) -> Chains:
    """A policy that misses now and then, and is forced at times."""
    return Chains(np.random.default_rng(seed).random((world.num_cells, world.num_choices, world.num_cells)) < 0.5)


def recorded(
    count: int, *, acting: Acting | None = None, seed: int = 0, max_steps: int | None = None, world: World = WORLD
) -> list[Episode]:
    seeds = [derive(seed, "episode", number) for number in range(count)]
    return list(record(limited(world, max_steps), acting or policy(world), seeds))


def write(
    file: Path,
    episodes: Sequence[Episode],
    *,
    acting: Acting | None = None,
    max_steps: int | None = None,
    world: World = WORLD,
) -> Path:
    acting = acting or policy(world)
    writer = EpisodeWriter(file, limited(world, max_steps), facts={"seed": "0"}, config=CONFIG)
    writer.add_policy(acting.facts, getattr(acting, "chains", None))
    for episode in episodes:
        writer.add(episode)
    return writer.finish()


def rewritten(source: Path, target: Path) -> Path:
    """The log read whole and written anew."""
    with EpisodeReader(source) as reader:
        tables = {name: reader.attachment(name) for name in ("config.yaml", "kernel.npy", "cost.npy")}
        writer = EpisodeWriter.copy(target, reader.run, tables)
        for number, facts in enumerate(reader.policies):
            plain = {key: value for key, value in facts.items() if key != "table.sha256"}
            writer.copy_policy(plain, reader.policy_table(number))
        for episode in reader.episodes():
            writer.add(episode)
    return writer.finish()
