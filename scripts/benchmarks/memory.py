"""Peak memory of training beside the estimate that a run is checked by before it starts."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Iterator, Mapping

from benchmarks.clock import measured
from benchmarks.words import Row, as_words, world_of
from trackmdp.config.compose import compose
from trackmdp.training.devices import needs


def rows(
    words: Mapping[str, str],
    algos: tuple[str, ...] = ("hindsight", "ppo", "a2c", "dqn"),
    sizes: tuple[int, ...] = (5, 10, 20),
    frames: int = 300_000,
    threads: int = 1,
    device: str = "cpu",
) -> Iterator[Row]:
    """One row for each algorithm and side of the grid: the estimate, and the peak, Python and torch included."""
    for algo, size in itertools.product(algos, sizes):
        world = dict(words) | {"grid.size": str(size)}
        own = {
            "algo": algo,
            "collector.total_frames": frames,
            "optimal.enabled": False,  # the estimate is of training, without the solver
        }
        task = world_of(world)
        estimate = sum(needs(compose("train", own | {"grid.size": size}), task).values())
        typed = [*as_words(world), *(f"{key}={value}" for key, value in own.items())]
        typed += [f"threads={threads}", f"device={device}", "quiet=true"]
        with tempfile.TemporaryDirectory() as folder:
            usage = measured("train", *typed, f"hydra.run.dir={folder}/run")
        expected = estimate / 2**20
        yield {"algo": algo, "N": size, "expected_mib": expected, "peak_mib": usage.peak_mib}
