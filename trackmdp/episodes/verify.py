"""Proving a log: every episode is simulated again from its seed, and must come out bit for bit the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby

from trackmdp.episodes.episode import Episode, first_difference
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.record import Acting, Chains, RandomSets, record
from trackmdp.episodes.schema import versions_apart
from trackmdp.errors import UserError
from trackmdp.world.model import World

__all__ = ["BELIEF_TOLERANCE", "Verified", "acting_of", "verify"]

BELIEF_TOLERANCE = 1e-6
"""How far the belief may be off where other versions wrote the log; all else must still be the same to the bit."""

_AT_ONCE = 64  # episodes


@dataclass(frozen=True)
class Verified:
    """How many episodes came out the same, and the first difference (None if there is none)."""

    episodes: int
    steps: int
    difference: str | None


def verify(
    reader: EpisodeReader, *, numbers: list[int] | None = None, on_progress: Callable[[int], None] | None = None
) -> Verified:
    """Re-simulate the episodes `numbers` (all, with every byte of the file, if None) up to the first difference.

    Raises:
        UserError: the file is damaged.
    """
    if numbers is None:
        reader.check_all()
    wanted = [row["episode"] for row in reader.rows] if numbers is None else numbers
    tolerance = BELIEF_TOLERANCE if versions_apart(reader.run) else 0.0
    world, done, steps = reader.world(), 0, 0
    for policy, group in groupby(wanted, lambda number: reader.row(number)["policy"]):
        acting, mine = acting_of(reader, policy), list(group)
        for begin in range(0, len(mine), _AT_ONCE):
            for number, again in _again(reader, world, acting, mine[begin : begin + _AT_ONCE]):
                logged = reader.read(number)
                if difference := first_difference(logged, again, belief_tolerance=tolerance):
                    return Verified(done, steps, f"episode {number}, {difference}")
                done, steps = done + 1, steps + len(logged)
            if on_progress:
                on_progress(done)
    return Verified(done, steps, None)


def _again(reader: EpisodeReader, world: World, acting: Acting, numbers: list[int]) -> Iterator[tuple[int, Episode]]:
    seeds = [int(reader.row(number)["seed"]) for number in numbers]
    policy = reader.row(numbers[0])["policy"]
    again = record(world, acting, seeds, policy=policy)
    return zip(numbers, again, strict=True)


def acting_of(reader: EpisodeReader, number: int) -> Acting:
    """Policy `number` of a log, as it acted.

    Raises:
        UserError: of a kind unknown here.
    """
    facts = reader.policies[number]
    if facts["kind"] == "random_k":
        return RandomSets(int(reader.run["size"]) ** 2, int(facts["k"]))
    chains = reader.chains(number)
    if facts["kind"] != "chains" or chains is None:
        raise UserError(f"file={reader.file}: policy {number} is a {facts['kind']!r}, expected chains or random_k")
    return Chains(chains)
