"""What remembering pays on recorded tracks: `memory.py FILE ROWS COLUMNS [PRICE SAFE [T_MAX [STEP CELL]]]`.

FILE is as `kernel=tracks` takes it; positions need STEP, in seconds, and CELL, in metres. Without words the targets are
vehicles on a ring road, of either direction.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import trackmdp as tm
from trackmdp.algos.estimates.path_plans import choose_plan
from trackmdp.config.world import MEMORIES
from trackmdp.solvers.evaluate import evaluate
from trackmdp.training.evaluator import HeldOutEvaluator

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


def main(
    file: Path, size: tuple[int, int], price: float, safe: float, t_max: int = 1, **position: float
) -> None:
    """Print each memory's held-out reward per step, 95 % interval over tracks; validation tracks alone choose."""
    found = {}
    for memory in MEMORIES:
        tracks = tm.load_tracks(
            file, size, t_max=t_max, cost=price, safe_cost=safe, memory=memory, **position
        )
        policy = choose_plan(
            tracks.task, tracks.tracks, judge=tracks.validation, discount=0.9
        ).policy
        held_out = HeldOutEvaluator(tracks)
        reward = held_out.replayed(policy).intervals(held_out.tracks.names)["reward_per_step"]
        found[memory] = (evaluate(tracks.selection, policy).aihtr, reward)
    best = max(found, key=lambda memory: found[memory][0])
    for memory, (_, reward) in found.items():
        interval = f"({reward.low:.3f} ... {reward.high:.3f}) on {reward.n} tracks"
        print(
            f"{memory:18} {reward.mean:6.3f} {interval}{', the choice of the validation' * (memory == best)}"
        )


if __name__ == "__main__":
    if len(sys.argv) > 3:
        numbers = [float(word) for word in sys.argv[2:]]
        rows, columns, price, safe, t_max, *step_and_cell = (
            numbers + [0.2, 2.0, 1][max(len(numbers) - 2, 0) :]
        )
        known = dict(zip(("step", "cell"), step_and_cell, strict=False))
        main(Path(sys.argv[1]), (int(rows), int(columns)), price, safe, int(t_max), **known)
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(vehicles(Path(folder) / "ring.csv"), (4, 4), 0.2, 2.0)
