"""The POMDP's exact belief filter (paper, eq. belief_up, with the indices of the process as it runs)."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor


class BeliefFilter:
    """Belief over the cells of a target known to be in the grid: `[B, M]` float64 rows that sum to 1.

    One step is `predict`, then `detect` or `miss`. All methods are pure.
    """

    def __init__(self, kernel: sparse.csr_array) -> None:
        self.num_cells: int = kernel.shape[0]
        self._into = kernel.T.tocsr()  # entry (y, x): from x into y

    def detect(self, cell: Tensor) -> Tensor:
        """Certainty after a detection in `cell` `[B]`."""
        return torch.nn.functional.one_hot(cell, self.num_cells).double()

    def predict(self, belief: Tensor) -> Tensor:
        """`[B, M]` predicted probability of each cell after one move; a row sums to the probability of no exit."""
        return summed(self._into, belief)

    def miss(self, predicted: Tensor, action: Tensor) -> Tensor:
        """Condition `predicted` `[B, M]` on no detection under `action` `[B, M]` and no exit.

        `action` is bool, or the probability of a report from each cell: p_d where a sensor is on that may miss.
        Where that event has probability zero the prediction itself is returned, normalised over the grid: the
        observation cannot have happened, and the belief stays finite.
        """
        # Bayes with a perfect sensor: a miss has likelihood 0 where a sensor is on and 1 elsewhere.
        unseen = predicted * (~action if action.dtype == torch.bool else 1.0 - action)
        mass = unseen.sum(-1, keepdim=True)
        grid = predicted / predicted.sum(-1, keepdim=True).clamp_min(torch.finfo(predicted.dtype).tiny)
        # `where` evaluates both sides; the clamps keep 0 / 0 out of the one that is not taken.
        return torch.where(mass > 0, unseen / mass.clamp_min(torch.finfo(predicted.dtype).tiny), grid)


def summed(into: sparse.csr_array, belief: Tensor) -> Tensor:
    """`into` `[Y, X]` times each row of `belief` `[B, X]`, with sums whose order does not depend on B.

    A product of dense matrices may add up in another order for one row than for many, which would make an episode
    differ in the last bit when it is simulated again alone; a sparse one adds up each result entry by entry.
    """
    return torch.from_numpy(np.ascontiguousarray((into @ np.ascontiguousarray(belief.numpy().T)).T))
