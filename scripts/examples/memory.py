"""What remembering pays on recorded tracks: `python scripts/examples/memory.py FILE ROWS COLUMNS [PRICE SAFE]`.

FILE is as `kernel=tracks` takes it. Without words the targets are vehicles on a ring road, of either direction.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import trackmdp as tm
from trackmdp.solvers.path_counts import plan_keys
from trackmdp.training.held_out import HeldOutEvaluator

RING = [1, 2, 3, 7, 11, 15, 14, 13, 12, 8, 4, 0]
"""The border cells of a grid of 4 x 4, in order."""


def vehicles(file: Path, count: int = 200) -> Path:
    """Tracks that go round the ring, one cell a step or with chance .2 none; half of them the other way."""
    rng, lines = np.random.default_rng(0), ["track,cell"]
    for track in range(count):
        steps = (rng.random(20) > 0.2) * (1 if track % 2 else -1)
        places = (rng.integers(12) + np.cumsum(steps)) % 12
        lines += [f"{track},{RING[place]}" for place in places]
    file.write_text("\n".join(lines) + "\n")
    return file


def main(file: Path, size: tuple[int, int], price: float, safe: float) -> None:
    """Print the held-out reward per step of each memory, with its 95 % interval over tracks."""
    for memory in ("cell", "displacement", "displacement_gap"):
        tracks = tm.load_tracks(file, size, t_max=1, cost=price, safe_cost=safe, memory=memory)
        found = plan_keys(tracks.task, tracks.tracks, prior=10, discount=0.9, rounds=8)
        reward = HeldOutEvaluator(tracks).intervals(found.policy)["reward_per_step"]
        print(f"{memory:17} {reward.mean:6.3f} ({reward.low:.3f} ... {reward.high:.3f}) on {reward.n} tracks")


if __name__ == "__main__":
    if len(sys.argv) > 3:
        numbers = [float(word) for word in sys.argv[2:]]
        rows, columns, price, safe = numbers + [0.2, 2.0][len(numbers) - 2 :]
        main(Path(sys.argv[1]), (int(rows), int(columns)), price, safe)
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(vehicles(Path(folder) / "ring.csv"), (4, 4), 0.2, 2.0)
