"""Recorded tracks: learn from most of them, value on those held out, without a motion model."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

import trackmdp as tm

SIZE = 6


def record(file: Path, tracks: int = 500, steps: int = 40) -> None:
    """Write made-up walks to `file`: columns track, row, column, one line per step."""
    rng = np.random.default_rng(0)
    start = rng.integers(0, SIZE, (tracks, 1, 2))
    walk = np.clip(start + rng.integers(-1, 2, (tracks, steps, 2)).cumsum(axis=1), 0, SIZE - 1)
    track = np.repeat(np.arange(tracks), steps)
    table = np.column_stack([track, walk.reshape(-1, 2)])
    np.savetxt(file, table, fmt="%d", delimiter=",", header="track,row,column", comments="")


def main() -> None:
    """Print figures on the held-out tracks, each with its 95 % interval."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tracks.csv"
        record(file)
        tracks = tm.load_tracks(file, size=SIZE, ends="cut", cost=0.1, t_max=1)
        run = tm.train(tracks, "hindsight", seed=0)
    for name, figures in run.summary["held_out"]["figures"].items():
        reward = figures["reward_per_step"]
        print(f"{name:32} reward per step {reward['mean']:7.3f}   95 % {reward['low']:.3f} ... {reward['high']:.3f}")


if __name__ == "__main__":
    main()
