"""Default runs of several seeds: one command each, one sweep, and one sweep on all cores."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping

from benchmarks.clock import measured
from benchmarks.words import Row, as_words


def rows(words: Mapping[str, str], runs: int = 16, repeat: int = 1) -> Iterator[Row]:
    """One row for each way, `repeat` times in turns; `times_faster` is over the commands one after the other."""
    train = ("train", "quiet=true", *as_words(words))
    many = (*train, "-m", f"seed=range({runs})")
    alone = [(*train, f"seed={seed}", "hydra.run.dir=") for seed in range(runs)]
    ways = {
        "one command each": alone,
        "one sweep": [(*many, "hydra.sweep.dir=")],
        "one sweep, joblib": [(*many, "hydra/launcher=joblib", "hydra.sweep.dir=")],
    }
    for _ in range(repeat):
        first = 0.0
        for name, commands in ways.items():
            with tempfile.TemporaryDirectory() as folder:
                wall = sum(
                    measured(*typed, f"{last}{folder}/{number}").wall_seconds
                    for number, (*typed, last) in enumerate(commands)
                )
            first = first or wall
            yield {"way": name, "runs": runs, "wall_seconds": wall, "times_faster": first / wall}
