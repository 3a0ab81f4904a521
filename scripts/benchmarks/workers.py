"""Speed-up of several worker processes that solve the blocks of one grid."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping

import trackmdp as tm
from benchmarks.words import Row, world_of


def rows(
    words: Mapping[str, str], block: int = 10, workers: tuple[int, ...] = (1, 2, 1, 2)
) -> Iterator[Row]:
    """One row for each number of workers, in the order typed: 1, 2, 1, 2 takes turns.

    `speed_up` is over the last row of one worker. `allowed` is the speed-up on idle cores: all CPU seconds, over those
    of this process, whose work is not shared, plus an equal share of the workers' seconds.
    """
    world = world_of(words)
    alone = None
    for number in workers:
        before, began = os.times(), time.perf_counter()
        found = tm.solve(world, block=block, workers=number)
        wall, after = time.perf_counter() - began, os.times()
        own = after.user + after.system - before.user - before.system
        # The workers have ended when `solve` returns, so that their seconds are counted here.
        shared = after.children_user + after.children_system
        shared -= before.children_user + before.children_system
        alone = wall if number == 1 else alone
        yield {
            "workers": number,
            "N": world.rows,
            "wall_seconds": wall,
            "own_seconds": own,
            "worker_seconds": shared,
            "speed_up": alone / wall if alone else None,
            "allowed": (own + shared) / (own + shared / number),
            "aihtr": found.lower,
        }
