"""Worlds of all kinds, drawn at random, with their figures: printed as JSON, to be compared with those of a checkout.

A program of its own, started by `part=values` with the package of either checkout: `python drawn.py COUNT SEED`. The
tables of a world depend on the seed alone, so both draw the same ones.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
from scipy import sparse

import trackmdp as tm

KINDS = ("plain", "prices", "misses", "footprints", "window", "max_steps", "told", "memory")


def drawn(kind: str, rng: np.random.Generator) -> dict[str, Any]:
    """Arguments of a world of one kind: grids of up to 4 x 4, random successors, exits and prices, T_max up to 3."""
    rows, columns = rng.integers(2, 5, 2).tolist()
    cells, modes = rows * columns, int(rng.integers(2, 4)) if kind in ("told", "memory") else 1
    states = cells * modes
    kernel = rng.random((states, states)) * (rng.random((states, states)) < 4 / cells / modes)
    kernel[np.arange(states), rng.integers(0, states, states)] += 0.1  # a successor each
    kernel *= rng.uniform(0.6, 0.95, (states, 1)) / kernel.sum(axis=1, keepdims=True)
    made = {"kernel": kernel, "size": (rows, columns), "t_max": int(rng.integers(0, 4))}
    made |= {"cost": float(rng.uniform(0.05, 0.4)), "safe_cost": float(rng.uniform(0.5, 4))}
    if kind == "prices":
        made["cost"] = rng.uniform(0.02, 0.5, cells)
    if kind == "misses":
        made["detection"] = rng.uniform(0.5, 1, cells)
        made["safe_detection"] = rng.uniform(0.5, 1, cells)
    if kind == "footprints":
        made["coverage"] = (rng.random((4, cells)) < 0.4) | (
            np.arange(cells) % 4 == np.arange(4)[:, None]
        )
    if kind == "window":
        made["window"] = int(rng.integers(0, 3))
    if kind == "max_steps":
        made["max_steps"] = int(rng.integers(1, 9))
    if modes > 1:
        made |= {"modes": modes, "revealed": modes if kind == "told" else 1}
        made["memory"] = "cell" if kind == "told" else str(rng.choice(["cell", "displacement"]))
    return made


def world_of(made: dict[str, Any]) -> Any:
    """The world, where modes are of a class of their own as well."""
    kind = getattr(tm, "HiddenWorld", tm.World) if "modes" in made else tm.World
    return kind(made["kernel"], **{name: value for name, value in made.items() if name != "kernel"})


def figures(world: Any, rng: np.random.Generator) -> dict[str, Any]:
    """Exact figures of a random policy and of Q_MDP's, and the solver's bracket."""
    rows = world.num_keys * (world.t_max + 1)
    on = rng.random((rows, world.total_sensors)) < 0.4
    if world.window is not None:
        row, column = np.divmod(np.arange(world.num_cells), world.columns)
        apart = np.maximum(*(abs(each[:, None] - each) for each in (row, column)))
        on &= np.repeat(apart <= world.window, world.t_max + 1, axis=0)
    random = tm.evaluate(world, tm.Policy(world, sparse.csr_array(on)))
    found = [*random.value.tolist(), random.accuracy, random.sensors_per_step]
    if world.max_steps is not None:  # which solvers refuse
        return {"exact": found}
    # With modes the baseline is another one in each package.
    if world.kernel.shape[0] == world.num_cells:
        found.append(tm.solve(world, "qmdp").evaluation.aihtr)
    solved = tm.solve(world)
    return {
        "exact": found,
        "lower": float(solved.lower),
        "upper": float(solved.upper),
        "certified": bool(solved.certified),
    }


def main(count: int, seed: int) -> None:
    """Print one line of JSON for each of `count` worlds."""
    for number in range(count):
        rng, kind = np.random.default_rng([seed, number]), KINDS[number % len(KINDS)]
        made = drawn(kind, rng)
        sys.stdout.write(json.dumps({"kind": kind} | figures(world_of(made), rng)) + "\n")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
