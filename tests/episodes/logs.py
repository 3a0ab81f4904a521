"""Small logs to read, damage and verify."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.helpers import limited, small_world
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.schema import TABLES
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World

CONFIG = "quiet: true\n"
WORLD = small_world(4, t_max=2, exit_probability=0.04, seed=1)


def policy(world: World = WORLD, seed: int = 5) -> Policy:
    """A policy that misses now and then, and is forced at times."""
    shape = (world.num_cells, world.num_choices, world.num_cells)
    return Policy.from_dense(world, np.random.default_rng(seed).random(shape) < 0.5)


def recorded(
    count: int,
    *,
    acting: Policy | None = None,
    seed: int = 0,
    max_steps: int | None = None,
    world: World = WORLD,
) -> list[Episode]:
    return list(
        simulate(limited(world, max_steps), acting or policy(world), count, seed=seed).complete()
    )


def write(
    file: Path,
    episodes: Sequence[Episode],
    *,
    acting: Policy | None = None,
    max_steps: int | None = None,
    world: World = WORLD,
) -> Path:
    writer = EpisodeWriter.of(file, limited(world, max_steps), facts={"seed": "0"}, config=CONFIG)
    writer.add_policy({}, acting or policy(world))
    for episode in episodes:
        writer.add(episode)
    return writer.finish()


def rewritten(source: Path, target: Path) -> Path:
    """The log read whole and written anew."""
    with EpisodeReader(source) as reader:
        tables = {name: reader.attachment(name) for name in TABLES}
        writer = EpisodeWriter(target, reader.said, tables)
        for number, facts in enumerate(reader.policies):
            plain = {key: value for key, value in facts.items() if not key.startswith("table")}
            writer.copy_policy(plain, reader.policy_tables(number))
        for episode in reader.episodes():
            writer.add(episode)
    return writer.finish()
