"""The target's motion as a sampler derived from the kernel table."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

__all__ = ["Motion"]

_RESOLUTION = 2**40  # with cell numbers below 2^13, cell + draw is exact in float64


class Motion:
    """Samples x_{k+1} ~ P(x_k, ·) for a batch of targets.

    The rows of the table, each closed by the exit, lie end to end on one line: cell x owns [x, x+1). One binary search
    of x + u therefore finds the successor, whatever the support of the row. The exit is cell number M, and stays there.
    """

    def __init__(self, kernel: sparse.csr_array, device: torch.device | str = "cpu") -> None:
        m = kernel.shape[0]
        closed = np.zeros((m + 1, m + 1))
        closed[:m, :m] = kernel.toarray()
        closed[:, m] = np.clip(1.0 - closed.sum(axis=1), 0.0, 1.0)
        rows, successors = np.nonzero(closed)
        edges = np.minimum(np.cumsum(closed, axis=1)[rows, successors], 1.0)  # a sum may round to more
        last = np.append(rows[1:] != rows[:-1], True)
        edges[last] = 1.0
        self._edges = torch.as_tensor(rows + edges, device=device)
        self._successors = torch.as_tensor(successors, device=device)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`[count]` uniform draws for `move`."""
        draws = torch.randint(_RESOLUTION, (count,), generator=generator, device=self._edges.device)
        return draws.double() / _RESOLUTION

    def move(self, cells: Tensor, draws: Tensor) -> Tensor:
        """`[B]` next cells of the targets at `cells` `[B]` under uniform `draws` `[B]`; M means exited."""
        return self._successors[torch.searchsorted(self._edges, cells + draws, right=True)]
