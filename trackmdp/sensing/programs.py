"""Linear and integer programs of weighted coverage (`cover`), solved by HiGHS."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.arrays.types import Array, BoolArray

PROVED = 1e-9
"""Part of the possible gain up to which a set counts as the best: rounding of linear and integer programs."""
_SCALE = 1e5
"""The largest gain in an integer program."""


def relaxed(
    sees: sparse.csr_array,
    gain: Array,
    price: Array,
    most: Array,
    sums: sparse.csr_array,
    budget: int,
) -> tuple[Array, Array, Array]:
    """Shares `[G]` of the linear program, and the prices of its limits.

    These are lambda `[E]` in [0, gain], of each entry's being reported, and mu `[K]`, of the `budget` that each of the
    `sums` `[K, G]` of shares keeps to.
    """
    from scipy.optimize import linprog  # a tenth of a second to load

    p, e = sees.shape
    # Minimise price x - gain z; z_e - (sees^T x)_e <= 0.
    constraint = sparse.block_array([[-sees.T, sparse.eye_array(e)], [sums, None]], format="csr")
    found = linprog(
        np.concatenate([price, -gain]),
        A_ub=constraint,
        b_ub=np.repeat([0.0, budget], [e, sums.shape[0]]),
        bounds=np.stack([np.zeros(p + e), np.concatenate([np.ones(p), most])], axis=1),
        method="highs",
    )
    if found.status != 0:  # never seen; all on and no prices is a bound as well
        return np.ones(p), np.zeros(e), np.zeros(sums.shape[0])
    limits = -found.ineqlin.marginals
    return np.clip(found.x[:p], 0, 1), np.clip(limits[:e], 0, gain), np.maximum(limits[e:], 0)


def integer(
    sees: sparse.csr_array, gain: Array, price: Array, budget: int | None
) -> tuple[BoolArray, float]:
    """The best set `[G]` of one row, where no sensor misses, and its proved bound."""
    from scipy.optimize import Bounds, LinearConstraint, milp  # as above

    used = np.flatnonzero(np.diff(sees.tocsc().indptr))
    sees, gain = sees[:, used], gain[used]
    p, e = sees.shape
    # z_e = 1 iff some sensor of e is on: z_e <= sum of x_s; and x_s <= z_e, which binds where seeing e is a loss.
    pairs = sees.tocoo()
    loss = gain[pairs.col] < 0
    sensor, entry = pairs.row[loss], pairs.col[loss]
    count = np.arange(len(sensor))
    signs = np.repeat([1.0, -1.0], len(count))
    place = (np.tile(count, 2), np.concatenate([sensor, p + entry]))
    forced = sparse.csr_array((signs, place), shape=(len(count), p + e))
    union = sparse.hstack([-sees.T, sparse.eye_array(e)], format="csr")
    few = sparse.csr_array(np.repeat([[1.0, 0.0]], [p, e], axis=1))
    limits = np.append(np.zeros(e + len(count)), p if budget is None else min(budget, p))
    # HiGHS stops once the best set and its bound are within 1e-6: of numbers this much larger that is nothing.
    scale = _SCALE / max(float(gain.max(initial=0.0)), 1e-300)
    found = milp(
        scale * np.concatenate([price, -gain]),
        constraints=LinearConstraint(sparse.vstack([union, forced, few], format="csr"), ub=limits),
        integrality=np.concatenate([np.ones(p), np.zeros(e)]),
        bounds=Bounds(0, 1),
        options={"mip_rel_gap": 0.0},
    )
    if found.x is None:
        return np.zeros(p, bool), np.inf
    return found.x[:p] > 0.5, float(-found.mip_dual_bound) / scale * (1.0 + PROVED)
