"""Brackets of the optimal value that `solve` proves on worlds whose beliefs spread."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import trackmdp as tm
from benchmarks.spreading import worlds as spreading_worlds
from benchmarks.words import Row

PROVED = (
    # Certified at T_max 2, at T_max 3 and, on grids of 10, 20 and 30, at T_max 5; the last three stay open.
    *((name, 10, 2) for name in ("drift .7 c .16", "drift .7 c .22", "drift .7 c .3")),
    *((name, 10, 2) for name in ("walk c .1", "walk c .2", "walk c .3", "walk c .4")),
    *((name, 10, 2) for name in ("support c .4", "far jumps")),
    ("walk c .3", 10, 3),
    *(("support c .22", size, 5) for size in (10, 20, 30)),
    *(("diagonal c .3", 10, 2), ("20 successors c .08", 10, 2), ("drift .7 c .3", 10, 3)),
)
"""Name of the world, side of its grid, and T_max."""


def rows(
    words: Mapping[str, str],  # noqa: ARG001
    worlds: tuple[str, ...] = (),
    nodes: int = 1_000_000,
) -> Iterator[Row]:
    """One row for each world; `worlds` are parts of their names."""
    for name, size, t_max in PROVED:
        make = spreading_worlds(size, t_max, worlds).get(name)
        if make is None:
            continue
        started = time.process_time()
        found = tm.solve(make(), nodes=nodes)
        yield {
            "world": name,
            "N": size,
            "T_max": t_max,
            "bracket_per_step": (found.upper - found.lower) / found.evaluation.expected_length,
            "nodes": found.nodes,
            "cpu_seconds": time.process_time() - started,
        }
