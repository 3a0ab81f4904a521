"""Targets that switch between kernels of cells, such as to linger and to travel."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from trackmdp.config.options import GROUPS
from trackmdp.config.registry import make
from trackmdp.world.checks import canonical_kernel, check_kernel
from trackmdp.world.model import Array, Size, grid_size


def regimes(size: Size, *, stay: float | list[float], regimes: list[dict[str, Any]]) -> tuple[sparse.csr_array, int]:
    """The regime is kept with `stay`, else any other is as likely; then the target moves by the new one's kernel.

    Args:
        size: of the grid.
        stay: one number, or one per regime.
        regimes: of each the kernel's name under `kernel`, and all its options.

    Returns:
        The kernel on (cell, regime), and how many regimes there are.

    Raises:
        UserError: a table is no kernel for this grid.
    """
    kernels = [_kernel(size, f"kernel.regimes[{place}]", entry) for place, entry in enumerate(regimes)]
    count = len(kernels)
    kept = np.broadcast_to(np.asarray(stay, dtype=np.float64), (count,))
    return switching(kernels, np.where(np.eye(count) > 0, kept[:, None], (1.0 - kept[:, None]) / (count - 1))), count


def switching(kernels: list[sparse.csr_array], switch: Array) -> sparse.csr_array:
    """`[M · H, M · H]` on z = cell · H + mode, of H kernels `[M, M]` and the probability of each next mode `[H, H]`.

    Q((x, u), (y, v)) = S(u, v) P_v(x, y): the Kronecker product of P_v and of S with its column v alone, for each v.
    """
    columns = np.eye(len(kernels))
    parts = [sparse.kron(kernel, sparse.csr_array(switch * own)) for kernel, own in zip(kernels, columns, strict=True)]
    return sparse.csr_array(sum(parts[1:], parts[0]))


def _kernel(size: Size, source: str, entry: dict[str, Any]) -> sparse.csr_array:
    """The kernel `[M, M]` of a regime."""
    options = {name: value for name, value in entry.items() if name != "kernel"}
    kernel = canonical_kernel(make(GROUPS["kernel"][entry["kernel"]](**options), size), source)
    # One regime may have no exit as long as another one has.
    check_kernel(kernel, grid_size(size), truncates=True, source=source)
    return kernel
