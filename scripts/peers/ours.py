"""One of our learners as a peer: `ours.py INSTANCE RECORD --seed N --algo NAME`, at its default budget."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import track

import trackmdp as tm
from trackmdp.training.callbacks import Callback, Row, Training


class Kept(Callback):
    """Records the policy at the start and, when it is due, after an iteration."""

    def __init__(self, record: track.Record) -> None:
        self.record = record

    def on_start(self, trainer: Training) -> None:
        self.record.keep(lambda: _sets(trainer), 0)

    def on_update(self, trainer: Training, row: Row) -> None:
        self.record.keep(lambda: _sets(trainer), trainer.position.frames, last=trainer.due(10**9))


def _sets(trainer: Training) -> np.ndarray:
    policy = trainer.policy()
    if policy.alike:  # before the first update all sensors are on with one probability
        return np.zeros((policy.task.num_cells, policy.task.t_max + 1, policy.task.num_cells), bool)
    return policy.sets.toarray() > 0


def main() -> None:
    """Learn to the end."""
    parser = track.arguments(__doc__)
    parser.add_argument("--algo", default="hindsight")
    words = parser.parse_args()
    with np.load(words.instance, allow_pickle=False) as stored:
        given = {name: stored[name] for name in ("kernel", "cost")}
        rest = {name: stored[name].tolist() for name in ("size", "safe_cost", "reward", "t_max")}
    world = tm.World(**given, **rest)
    record = track.Record(words.record, seconds=float("inf"))  # of a default budget all is recorded
    # No evaluation but the last, and no optimum: they are not learning.
    own = {"evaluation.every": 10**9, "optimal.enabled": False, "threads": 1}
    tm.train(world, words.algo, seed=words.seed, callbacks=[Kept(record)], **own)
    record.save()


if __name__ == "__main__":
    main()
