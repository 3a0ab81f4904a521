"""Worlds whose beliefs spread, where sets of sensors have to change together; for `part=regret` and `part=bracket`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeAlias

import numpy as np

import trackmdp as tm

Maker: TypeAlias = Callable[[], Any]
"""Makes a `World`."""
Makers: TypeAlias = Callable[..., Maker]
"""From the arguments of `make_world`, but for the size and T_max."""


def worlds(size: int, t_max: int, named: Iterable[str] = ()) -> dict[str, Maker]:
    """Name -> maker of the worlds on `size` x `size` cells whose names contain one of `named`; all without `named`."""
    # A call such as `make("drift", cost=.2)` gives the maker of that world on this grid.
    make = partial(partial, tm.make_world, size=size, t_max=t_max)
    found = _plain(make) | _priced(make, size**2) | _tables(size, t_max)
    return {name: found[name] for name in found if not named or any(word in name for word in named)}


def _plain(make: Makers) -> dict[str, Maker]:
    found: dict[str, Maker] = {}
    for p in (0.5, 0.6, 0.7):
        for c in (0.16, 0.22, 0.3):
            found[f"drift {_text(p)} c {_text(c)}"] = make("drift", cost=c, persistence=p)
    for z, seed in ((3, 63), (4, 63), (5, 39)):  # as in experiment=paper
        for c in (0.16, 0.18, 0.2, 0.22):
            found[f"paper Z {z} c {_text(c)}"] = make(
                "random_support", cost=c, support_size=z, seed=seed
            )
    for c in (0.1, 0.2, 0.3, 0.4):
        found[f"walk c {_text(c)}"] = make("random_walk", cost=c)
    for c in (0.1, 0.2, 0.3):
        found[f"diagonal c {_text(c)}"] = make("random_walk", cost=c, diagonal=True)
    return found | {
        "support c .22": make("random_support", cost=0.22),
        "support c .4": make("random_support", cost=0.4),
        "Z 9 c .16": make("random_support", cost=0.16, support_size=9),
        "radius 2 c .16": make("random_support", cost=0.16, radius=2),
        "Z 9 radius 2 c .1": make("random_support", cost=0.1, support_size=9, radius=2),
    }


def _priced(make: Makers, cells: int) -> dict[str, Maker]:
    """Worlds with prices per cell, with other prices D of the safe action, and with a border that is an exit."""
    rng = np.random.default_rng(1)
    uniform = rng.uniform(0.02, 0.5, cells).tolist()
    some_free = np.where(rng.random(cells) < 0.25, 0, 0.25).tolist()
    lognormal = np.minimum(0.2 * np.exp(0.8 * rng.standard_normal(cells)), 2).tolist()
    found: dict[str, Maker] = {}
    for safe in (0, 1, 1000):
        found[f"D {safe} support c .22"] = make("random_support", cost=0.22, safe_cost=safe)
        found[f"D {safe} drift .7 c .22"] = make("drift", cost=0.22, safe_cost=safe)
    dear = {"safe_cost": 1000, "exit_probability": 0.001}
    return found | {
        "exit border, drift .6 c .22": make("drift", cost=0.22, border="exit", persistence=0.6),
        "exit border, walk c .3": make("random_walk", cost=0.3, border="exit"),
        "prices .02-.5, drift .7": make("drift", cost=uniform),
        "prices .02-.5, support": make("random_support", cost=uniform),
        "quarter free, walk": make("random_walk", cost=some_free),
        "quarter free, drift .7": make("drift", cost=some_free),
        "lognormal prices, diagonal": make("random_walk", cost=lognormal, diagonal=True),
        "lognormal prices, support": make("random_support", cost=lognormal),
        "D 1000 support c .16 exit .001": make("random_support", cost=0.16, **dear),
        "D 1000 drift .7 c .22 exit .001": make("drift", cost=0.22, **dear),
    }


def _tables(size: int, t_max: int) -> dict[str, Maker]:
    near = {"reach": 1, "successors": 5}
    tables: dict[str, tuple[float, int, dict[str, Any]]] = {
        "far jumps": (0.2, 3, near | {"far": 3, "jumps": 0.3}),
        "rare far jumps": (0.2, 4, near | {"far": 2, "jumps": 0.03}),
        "20 successors c .08": (0.08, 5, {"reach": 2, "successors": 20}),
    }
    return {
        name: partial(tm.World, jumping(size, seed, **options), size, cost=cost, t_max=t_max)
        for name, (cost, seed, options) in tables.items()
    }


def jumping(
    size: int, seed: int, *, reach: int, successors: int, far: int = 0, jumps: float = 0.0
) -> np.ndarray:
    """`[M, M]` kernel: from each cell some cells at most `reach` away, and `far` cells anywhere.

    The probability of the far cells is `jumps` of all moves, that of the exit .005.
    """
    rng, kernel = np.random.default_rng(seed), np.zeros((size**2, size**2))
    row, column = np.divmod(np.arange(size**2), size)
    for x in range(size**2):
        near = np.flatnonzero(np.maximum(np.abs(row - row[x]), np.abs(column - column[x])) <= reach)
        chosen = rng.choice(near, min(successors, len(near)), replace=False)
        kernel[x, chosen] += rng.dirichlet(np.full(len(chosen), 2.0)) * (1.0 - jumps)
        if far:
            # Drawn with replacement: two jumps may lead to one cell.
            kernel[x, rng.integers(0, size**2, far)] += jumps / far
    return kernel * (0.995 / kernel.sum(axis=1, keepdims=True))


def _text(number: float) -> str:
    return f"{number:g}".lstrip("0")
