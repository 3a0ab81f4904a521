"""A grid solved by blocks: loss and gap per step by the width of the halo."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping
from itertools import product

import trackmdp as tm
from benchmarks.words import Row, world_of
from trackmdp.solvers.partition import default_halo


def rows(
    words: Mapping[str, str],
    blocks: tuple[int, ...] = (10, 5),
    halos: tuple[int, ...] = (0, 1, 2, 4, 6),
    costs: tuple[float, ...] = (0.16, 0.22),
    t_max: tuple[int, ...] = (1, 2),
) -> Iterator[Row]:
    """One row for each price, T_max, side of the blocks and halo.

    A row without sweeps is the blocks' own plan. The last row of each block has the default halo, and the sweeps of
    exchange over the whole grid. All rows have the kernel and the price D of `words`.
    """
    world = world_of(words)
    for cost, misses in product(costs, t_max):
        here = world.but(cost=cost, t_max=misses)
        whole = tm.solve(here)
        length = whole.evaluation.expected_length
        widest = default_halo(here)
        for block, halo in product(blocks, [*sorted({*halos, widest}), None]):
            started = time.process_time()
            with warnings.catch_warnings():
                # A halo that is too narrow is measured here, and no mistake.
                warnings.simplefilter("ignore")
                found = tm.solve(here, block=block, halo=halo)
            yield {
                "c": cost,
                "T_max": misses,
                "block": block,
                "halo": widest if halo is None else halo,
                "sweeps": halo is None,
                "loss_per_step": (whole.lower - found.lower) / length,
                "gap_per_step": (found.upper - found.lower) / length,
                "cpu_seconds": time.process_time() - started,
            }
