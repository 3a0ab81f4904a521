"""What the peers share: the instance they learn on, what a policy is shown, and the record a run leaves. Only numpy.

A peer is a script `<name>_peer.py`, called with INSTANCE.npz, RECORD.npz, --seed and --seconds. `scripts/benchmark.py
part=peers` writes the instance, and values the policies in the record as it values its own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np


class Instance:
    """A Track-MDP: the target's kernel, the prices, and T_max; and the target's next cell by inverse transform.

    Attributes:
        cells: `[M, S + 1]` cells that can follow, the last column standing for the exit.
        cumulated: `[M, S]` cumulated probabilities: the next cell is number `#(u > cumulated)` for u uniform in [0, 1).
    """

    def __init__(self, file: str) -> None:
        with np.load(file, allow_pickle=False) as stored:
            kernel, self.cost = stored["kernel"], stored["cost"]
            self.safe_cost, self.reward, self.t_max = (
                stored[key].item() for key in ("safe_cost", "reward", "t_max")
            )
        self.num_cells = m = len(kernel)
        support = int((kernel > 0).sum(axis=1).max())
        self.cells = np.zeros((m, support + 1), np.int32)
        self.cumulated = np.full((m, support), 2.0, np.float32)
        for cell, row in enumerate(kernel):
            after = np.flatnonzero(row)
            self.cells[cell, : len(after)] = after
            # u above the last cumulated probability is the exit, so the unused columns repeat it
            self.cumulated[cell] = np.cumsum(row[after])[
                np.minimum(np.arange(support), len(after) - 1)
            ]
        self.choices = self.t_max + 1
        self.width = m + self.choices + 1 + self.choices * m

    def observe(self, last: np.ndarray, misses: np.ndarray, history: np.ndarray) -> np.ndarray:
        """`[B, width]`: where it was last located, how many misses ago, and the sets sensed since `[B, T_max+1, M]`."""
        shown = np.zeros((len(last), self.width), np.float32)
        rows = np.arange(len(last))
        shown[rows, last] = 1.0
        shown[rows, self.num_cells + misses] = 1.0
        shown[:, self.num_cells + self.choices + 1 :] = history.reshape(len(last), -1)
        return shown

    def table(self, greedy: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """`[M, T_max+1, M]` the sets of a deterministic policy: after a miss its next state is known in advance."""
        m = self.num_cells
        sets = np.zeros((m, self.choices, m), bool)
        for n in range(self.choices):
            sets[:, n] = greedy(self.observe(np.arange(m), np.full(m, n), sets.astype(np.float32)))
        return sets


class Record:
    """Greedy policies over the CPU seconds of the process, imports and compilation included, recording left out.

    CPU seconds are those of a clock where a core is free, and the same where others use it as well. Learning begins
    with the first record.
    """

    def __init__(self, file: str, seconds: float, every: float = 0.25) -> None:
        self.file, self.limit, self.every = file, seconds, every
        self.seconds: list[float] = []
        self.steps: list[int] = []
        self.sets: list[np.ndarray] = []
        self._recording = 0.0

    def keep(self, table: Callable[[], np.ndarray], steps: int, *, last: bool = False) -> bool:
        """Record the policy `table()` where it is due, and the `last`; returns whether there is time to learn on."""
        begun = time.process_time()
        spent = begun - self._recording
        end = bool(self.seconds) and spent >= self.seconds[0] + self.limit
        if last or end or not self.seconds or spent >= self.seconds[-1] + self.every:
            self.sets.append(np.packbits(table()))
            self.seconds.append(spent)
            self.steps.append(steps)
            self._recording += time.process_time() - begun
        return not end

    def save(self) -> None:
        """Write `seconds` `[E]`, `steps` `[E]` and the policies' `sets` `[E, bytes]`, as bits."""
        np.savez_compressed(
            self.file, seconds=self.seconds, steps=self.steps, sets=np.stack(self.sets)
        )


def arguments(about: str | None) -> argparse.ArgumentParser:
    """The parser of the words that every peer takes."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("instance", help="INSTANCE.npz, written by scripts/benchmark.py part=peers")
    parser.add_argument("record", help="RECORD.npz, to be written")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=120.0, help="of learning")
    return parser
