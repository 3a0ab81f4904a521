"""The POMDP's exact belief filter (paper, eq. belief_up, with the indices of the process as it runs)."""

from __future__ import annotations

import torch
from scipy import sparse
from torch import Tensor

__all__ = ["BeliefFilter"]


class BeliefFilter:
    """Belief over the cells of a target known to be in the grid: `[B, M]` float64 rows that sum to 1.

    One step is `predict`, then `detect` or `miss`. All methods are pure.
    """

    def __init__(self, kernel: sparse.csr_array, device: torch.device | str = "cpu") -> None:
        self.kernel = torch.as_tensor(kernel.toarray(), dtype=torch.float64, device=device)

    def detect(self, cell: Tensor) -> Tensor:
        """Certainty after a detection in `cell` `[B]`."""
        return torch.nn.functional.one_hot(cell, len(self.kernel)).to(self.kernel.dtype)

    def predict(self, belief: Tensor) -> Tensor:
        """`[B, M]` predicted probability of each cell after one move; a row sums to the probability of no exit."""
        return belief @ self.kernel

    def miss(self, predicted: Tensor, action: Tensor) -> Tensor:
        """Condition `predicted` `[B, M]` on no detection under `action` `[B, M]` and no exit.

        Where that event has probability zero the prediction itself is returned, normalised over the grid: the
        observation cannot have happened, and the belief stays finite.
        """
        unseen = predicted * ~action
        mass = unseen.sum(-1, keepdim=True)
        grid = predicted / predicted.sum(-1, keepdim=True).clamp_min(torch.finfo(predicted.dtype).tiny)
        return torch.where(mass > 0, unseen / mass.clamp_min(torch.finfo(predicted.dtype).tiny), grid)
