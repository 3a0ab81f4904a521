"""Regret of the learners on worlds whose beliefs spread."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

import numpy as np

import trackmdp as tm
from benchmarks.matrix import runs_of
from benchmarks.spreading import worlds as spreading_worlds
from benchmarks.words import Row, world_of


def rows(
    words: Mapping[str, str],
    algos: tuple[str, ...] = ("hindsight", "model_based"),
    seeds: tuple[int, ...] = (0, 1, 2),
    worlds: tuple[str, ...] = (),
    nodes: int = 1_000_000,
    device: str = "cpu",
) -> Iterator[Row]:
    """One row for each world and learner: regret per step to the proved bound, the open bracket included.

    Of `words` only `grid.size` and `grid.t_max` are used; `worlds` are parts of the worlds' names. `worst_to_best` is
    the worst run's regret to the best policy known, of the solver or of a run. All runs are in this process: none pays
    for Python's start-up.
    """
    grid = world_of(words)
    for name, make in spreading_worlds(grid.rows, grid.t_max, worlds).items():
        world = make()
        started = time.process_time()
        best = tm.solve(world, nodes=nodes)
        solved = time.process_time() - started
        length = best.evaluation.expected_length
        runs = {algo: runs_of(world, world, algo, seeds, device) for algo in algos}
        earned = {algo: np.array(each["values"]) for algo, each in runs.items()}
        known = max(best.lower, *(each.max() for each in earned.values()))
        for algo, each in earned.items():
            yield {
                "world": name,
                "T_max": grid.t_max,
                "algo": algo,
                "seeds": len(seeds),
                "worst": (best.upper - each.min()) / length,
                "mean": (best.upper - each.mean()) / length,
                "worst_to_best": (known - each.min()) / length,
                "bracket": (best.upper - best.lower) / length,
                "cpu_seconds_a_run": runs[algo]["seconds"],
                "solver_seconds": solved,
            }
