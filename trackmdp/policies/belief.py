"""The POMDP's exact belief filter (paper, eq. belief_up, with the indices of the process as it runs), in NumPy."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import AnyArray, Array, BoolArray, Indices
from trackmdp.sensing.coverage import reported
from trackmdp.sensing.task import Task


class BeliefFilter:
    """Belief over the hidden states of targets known to be in the grid: `[B, Z]` rows that sum to 1.

    State z is cell z // H and mode z % H, with H modes. One step is `predict`, then `detect` or `miss`. All methods are
    pure, and a row is the same to the bit for any other rows.

    Args:
        kernel: `[Z, Z]` moves of the states.
        modes: H.
    """

    def __init__(self, kernel: sparse.csr_array, modes: int = 1) -> None:
        self._into = kernel.T.tocsr()  # entry (y, x): from x into y
        self._modes, self._state = modes, np.arange(kernel.shape[0])

    def cells(self, belief: Array) -> Array:
        """`[B, M]` probability of each cell."""
        return belief.reshape(len(belief), -1, self._modes).sum(axis=2)

    def detect(
        self, cell: Indices, mode: Indices | None = None, predicted: Array | float = 1.0
    ) -> Array:
        """Condition `predicted` `[B, Z]`, by default every state alike, on a detection.

        In `cell` `[B]`, and in `mode` `[B]` where a detection gives it. Where it cannot have happened, every state that
        it leaves is as likely.
        """
        mask = self._state // self._modes == cell[:, None]
        if mode is not None:
            mask &= self._state % self._modes == mode[:, None]
        return _conditioned(predicted * mask, mask)

    def predict(self, belief: Array) -> Array:
        """Predicted probability of each state after one move; a row sums to the probability of no exit."""
        # Sparse: a product of dense matrices may add up in another order for one row than for many, which would make
        # an episode differ in the last bit when it is simulated again alone.
        return np.ascontiguousarray((self._into @ np.ascontiguousarray(belief.T)).T)

    def miss(self, predicted: Array, report: AnyArray) -> Array:
        """Condition `predicted` `[B, Z]` on no detection and no exit.

        `report` `[B, M]` is the probability of a report from each cell: whether a sensor is on, or p_d of one that may
        miss. Where that event has probability zero the prediction stands in, normalised over the grid: the observation
        cannot have happened, and the belief stays finite.
        """
        unseen = predicted * (1.0 - np.repeat(report, self._modes, axis=1))
        return _conditioned(unseen, predicted)


def _conditioned(weight: Array, otherwise: AnyArray) -> Array:
    """Rows scaled to sum 1; a row of zeros is replaced by that of `otherwise`."""
    chosen = np.where(weight.sum(axis=1, keepdims=True) > 0, weight, otherwise)
    # The least number keeps 0 / 0 out, of a target that has certainly left.
    return chosen / np.maximum(chosen.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)


class Reports:
    """The probability that a step reports a target in each cell.

    It is asked for step by step: of all steps at once it would take 8 bytes for each step and cell, 3 GB for 400 steps
    on a million cells.

    Args:
        world: its sensors and its safe action.
    """

    def __init__(self, world: Task) -> None:
        self._world = world
        certain = world.perfect and world.safe
        self._seen_by = None if certain else sparse.csr_array(world.sees_by_cell.T)

    def __call__(self, action: BoolArray, misses: Indices) -> AnyArray:
        """`[B, M]`, of actions `[B, S]` and n `[B]`; bool where reports are certain."""
        world, safe = self._world, (misses > self._world.t_max)[:, None]
        if self._seen_by is None:
            return world.covered(action) | safe
        seen = reported(sparse.csr_array(action.astype(np.float64)), self._seen_by).toarray()
        return np.where(safe, world.safe_detection, seen)
