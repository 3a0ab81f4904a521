"""The target's motion as a sampler derived from the kernel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.errors import UserError

_RESOLUTION = 2**40
"""Draws are multiples of 2^-40; no successor is more or less likely than in the kernel by more than that."""

_SHORT = 32
"""Entries of a row up to which its edges are compared one by one."""

_MOST_CELLS = 2**23 - 2
"""(M + 1) · 2^40, the end of the line, must be an int64."""


class Motion:
    """Samples x_{k+1} ~ P(x_k, ·) for a batch of targets.

    The rows of the kernel, each closed by the exit, lie end to end on one line of whole numbers: cell x owns
    [x · 2^40, (x + 1) · 2^40), and of it each successor the share that is its probability. One binary search of
    x · 2^40 + u · 2^40 therefore finds the successor, whatever the support of the row; being a search among integers it
    is exact for every cell of a large grid. The exit is cell number M, and stays there.
    """

    def __init__(self, kernel: sparse.csr_array, device: torch.device | str = "cpu") -> None:
        m = kernel.shape[0]
        if m > _MOST_CELLS:
            raise UserError(f"kernel: {m:,} cells, expected at most {_MOST_CELLS:,}")
        # Worked example, two cells, in units of 2^40: P_01 = .5, P_10 = .25, P_11 = .5. The ends within the rows are .5
        # and .25, .75; shifted by the cell and closed by the exit at 1 and 2, and by the exited target's own stretch at
        # 3, the line is edges .5 1 1.25 1.75 2 3 with successors 1 M 0 1 M M.
        ends = _running_sums(kernel)
        # A successor whose share ends at e is drawn for u < e. With u = k / 2^40 that is k < ceil(e · 2^40), exactly.
        edges = np.ceil(np.minimum(ends, 1.0) * _RESOLUTION).astype(np.int64)
        # What is left of 1 is the exit's. A row that reaches 1, up to rounding, leaves nothing.
        # after[x] is the end of cell x's stretch; `insert` puts it behind the row's own edges, at indptr[x + 1].
        after = np.arange(1, m + 1, dtype=np.int64) * _RESOLUTION
        edges += np.repeat(after - _RESOLUTION, np.diff(kernel.indptr))
        closed = np.append(np.insert(edges, kernel.indptr[1:], after), (m + 1) * _RESOLUTION)
        successors = np.append(np.insert(kernel.indices.astype(np.int64), kernel.indptr[1:], m), m)
        self._edges = torch.as_tensor(closed, device=device)
        self._successors = torch.as_tensor(successors, device=device)
        # Each row has one edge more than entries, so that x's begin at indptr[x] + x; M's is the last of all.
        self._first = torch.as_tensor(kernel.indptr.astype(np.int64) + np.arange(m + 1), device=device)
        width = int(np.diff(kernel.indptr).max(initial=0))
        self._within = torch.arange(width, device=device)[:, None] if 0 < width <= _SHORT else None

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`[count]` float64 uniform draws for `move`."""
        # Whole numbers over 2^40 are exact in float64 (53 bits), so `move` gets back the very integer that was drawn.
        draws = torch.randint(_RESOLUTION, (count,), generator=generator, device=self._edges.device)
        return draws.double() / _RESOLUTION

    def move(self, cells: Tensor, draws: Tensor) -> Tensor:
        """`[B]` next cells of the targets at `cells` `[B]` under uniform `draws` `[B]`; M means exited."""
        # The first edge beyond x + u: from cell 0, u = .3 finds edge .5 (to cell 1) and u = .7 finds 1 (exit).
        # right=True, since an edge is the first draw that no longer belongs to its successor.
        place = (draws * _RESOLUTION).long().add_(cells, alpha=_RESOLUTION)
        if self._within is not None:
            # Of a short row every edge is compared, which reads far less than a search in the edges of a large grid.
            # Edges of later rows, beyond x + u, are not counted, and no row has more below x + u than entries.
            first = self._first.index_select(0, cells)
            near = (first + self._within).clamp_max_(len(self._edges) - 1)
            passed = self._edges.index_select(0, near.view(-1)).view(near.shape) <= place
            return self._successors.index_select(0, first.add_(passed.sum(0)))
        return self._successors[torch.searchsorted(self._edges, place, right=True)]


def _running_sums(kernel: sparse.csr_array) -> npt.NDArray[np.float64]:
    """`[nnz]` for each entry the sum of its row up to and with it, added from left to right."""
    sums, lengths = kernel.data.astype(np.float64), np.diff(kernel.indptr)
    # One pass for each place in a row: a running sum over all entries at once would round differently in each row.
    for place in range(1, int(lengths.max(initial=0))):
        entry = kernel.indptr[:-1][lengths > place] + place
        sums[entry] += sums[entry - 1]
    return sums
