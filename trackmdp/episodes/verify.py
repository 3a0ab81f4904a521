"""Proving a log: every episode is simulated again from its seed, and must come out bit for bit the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

from trackmdp.episodes.episode import Episode, first_difference
from trackmdp.episodes.reader import EpisodeReader
from trackmdp.episodes.schema import versions_apart
from trackmdp.episodes.simulate import resimulate
from trackmdp.policies.policy import Policy
from trackmdp.world.modes import Modelled

BELIEF_TOLERANCE = 1e-6
"""How far the belief may be off where other versions wrote the log; all else must still be the same to the bit."""

_AT_ONCE = 64  # episodes


@dataclass(frozen=True)
class Verified:
    """How many episodes came out the same, and the first difference (None if there is none)."""

    episodes: int
    steps: int
    difference: str | None


def verify(reader: EpisodeReader, *, numbers: list[int] | None = None) -> Verified:
    """Re-simulate the episodes `numbers` (all, with every byte of the file, if None) up to the first difference.

    Raises:
        UserError: the file is damaged.
    """
    if numbers is None:
        reader.check_all()
    wanted = [row["episode"] for row in reader.rows] if numbers is None else numbers
    # The belief is a sum of products, which another version or processor may add up in another order.
    tolerance = BELIEF_TOLERANCE if versions_apart(reader.run.said) else 0.0
    world, done, steps = reader.world(), 0, 0
    for number_of_policy, group in groupby(wanted, lambda number: reader.row(number)["policy"]):
        policy, mine = reader.policy(number_of_policy), list(group)
        for begin in range(0, len(mine), _AT_ONCE):
            for number, again in _again(reader, world, policy, mine[begin : begin + _AT_ONCE]):
                logged = reader.read(number)
                if difference := first_difference(logged, again, belief_tolerance=tolerance):
                    return Verified(done, steps, f"episode {number}, {difference}")
                done, steps = done + 1, steps + len(logged)
    return Verified(done, steps, None)


def _again(reader: EpisodeReader, world: Modelled, policy: Policy, numbers: list[int]) -> Iterator[tuple[int, Episode]]:
    rows = [reader.row(number) for number in numbers]
    again = resimulate(world, policy, [int(row["seed"]) for row in rows]).complete()
    # Simulated episodes do not know under which number and policy they were logged.
    return ((row["episode"], replace(one, policy=row["policy"])) for row, one in zip(rows, again, strict=True))
