"""Worlds with known answers, and brute force written apart from the solvers."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from trackmdp.world.kernels import random_support
from trackmdp.world.model import Array, BoolArray, World

REFERENCES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "data" / "values.json").read_text(encoding="utf-8")
)
PAPER_REFERENCES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "data" / "paper_pairs.json").read_text(encoding="utf-8")
)


def reference_world(reference: dict[str, Any]) -> World:
    kernel = np.array(reference["kernel"])
    m = len(kernel)
    return World(
        kernel,
        round(m**0.5),
        cost=np.full(m, reference["c"]),
        safe_cost=reference["D"],
        t_max=reference["t_max"],
        reward=reference["r"],
    )


@cache
def paper_world(support_size: int, cost: float, t_max: int, size: int = 10) -> World:
    kernel = random_support(
        size,
        support_size=support_size,
        radius=1,
        low_probability=0.15,
        exit_probability=0.005,
        border="renormalize",
        seed=support_size,
    )
    return World(kernel, size, cost=np.full(size**2, cost), safe_cost=size**2 * cost, t_max=t_max)


@st.composite
def tiny_worlds(
    draw: st.DrawFn, *, size: int = 2, most_t_max: int = 1, support: int | None = None, misses: bool = False
) -> World:
    """Any kernel with some zeros, per-cell costs, and a safe action cheaper or dearer than all sensors.

    With `misses` sensors miss, and the safe action may.
    """
    m = size**2
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kernel = rng.random((m, m)) ** draw(st.sampled_from([1, 4]))
    kernel *= rng.random((m, m)) < draw(st.sampled_from([0.4, 0.7, 1.0]))
    if support is not None:
        kernel *= np.argsort(rng.random((m, m)), axis=1) < support
    kernel *= (1.0 - draw(st.sampled_from([0.02, 0.2]))) / np.maximum(kernel.sum(axis=1, keepdims=True), 1e-300)
    spread = draw(st.sampled_from([0.0, 1.0]))
    cost = draw(st.sampled_from([0.0, 0.1, 0.25, 0.5, 1.2])) * (1.0 + spread * rng.random(m))
    safe_cost = float(cost.sum()) * draw(st.sampled_from([0.1, 1.0, 3.0]))
    sensors: dict[str, Any] = {}
    if misses:
        sensors["detection"] = 1.0 - draw(st.sampled_from([0.05, 0.6])) * rng.random(m)
        sensors["safe_detection"] = draw(st.sampled_from([1.0, 0.7]))
    return World(
        kernel,
        size,
        cost=cost,
        safe_cost=safe_cost,
        t_max=draw(st.integers(0, most_t_max)),
        reward=draw(st.sampled_from([1.0, 2.0])),
        **sensors,
    )


def value_of(world: World, chains: BoolArray) -> Array:
    """`[M]` the value of a policy, by stepping through each chain one set at a time."""
    m = world.num_cells
    located, earned = np.zeros((m, m)), np.zeros(m)
    for x in range(m):
        earned[x], located[x] = renewal(world, x, chains[x])
    return np.linalg.solve(np.eye(m) - located, earned)


def renewal(world: World, x: int, chain: BoolArray) -> tuple[float, Array]:
    """Reward until the target is located again, and where it is then."""
    earned, located = 0.0, np.zeros(world.num_cells)
    mass = np.eye(world.num_cells)[x]
    for sensors in chain:
        mass = mass @ world.kernel
        found = np.where(sensors, mass * world.detection, 0.0)
        earned += world.reward * found.sum() - world.cost[sensors].sum() * mass.sum()
        located, mass = located + found, mass - found
    while mass.sum() > 1e-16:  # once only where the safe action always locates
        mass = mass @ world.kernel
        found = mass * world.safe_detection
        earned += world.reward * found.sum() - world.safe_cost * mass.sum()
        located, mass = located + found, mass - found
    return earned, located


def random_tiny_world(rng: np.random.Generator) -> World:
    """Three or four cells, T_max 0 to 4: prices per cell, some of them 0, and D from nothing to very dear."""
    t_max = int(rng.integers(5))
    size = (1, 3) if t_max >= 3 else (2, 2)
    m = size[0] * size[1]
    kernel = rng.random((m, m)) ** rng.choice([1.0, 4.0]) * (rng.random((m, m)) < rng.choice([0.5, 0.8, 1.0]))
    kernel *= (1.0 - rng.choice([0.02, 0.2])) / np.maximum(kernel.sum(axis=1, keepdims=True), 1e-300)
    cost = rng.choice([0.1, 0.25, 0.5]) * (1.0 + rng.random(m)) * (rng.random(m) < 0.8)
    safe_cost = float(cost.sum() * rng.choice([0.0, 0.3, 1.0, 30.0]))
    return World(kernel, size, cost=cost, safe_cost=safe_cost, t_max=t_max)


def best_of_all(world: World, allowed: BoolArray | None = None) -> Array:
    """`[M]` V*, every plan tried from every cell until no cell has a better one.

    `allowed` `[M, M]`: which sensors can be chosen from which located cell.
    """
    m = world.num_cells
    tried = [all_plans(world, x, None if allowed is None else allowed[x]) for x in range(m)]
    value = value_of(world, np.zeros((m, world.num_choices, m), dtype=bool))
    while True:
        picks = [int(np.argmax(earned + located @ value)) for earned, located, _ in tried]
        located = np.stack([options[1][pick] for options, pick in zip(tried, picks, strict=True)])
        earned = np.array([options[0][pick] for options, pick in zip(tried, picks, strict=True)])
        better = np.linalg.solve(np.eye(m) - located, earned)
        if better.sum() <= value.sum() + 1e-11:
            return value
        value = better


def all_plans(world: World, x: int, allowed: BoolArray | None = None) -> tuple[Array, Array, Array]:
    """Every plan from x: `[C]` its reward, `[C, M]` where the target is located, and the sum of z_t undetected.

    Its sets are those of cells that can be reached in that many moves; a sensor anywhere else only costs.
    """
    m, mass, earned = world.num_cells, np.eye(world.num_cells)[[x]], np.zeros(1)
    kernel, reachable, located, waited = world.kernel.toarray(), mass[0], np.zeros((1, m)), np.zeros((1, m))
    for _ in range(world.num_choices):
        mass, reachable = mass @ kernel, reachable @ kernel
        cells = np.flatnonzero(reachable if allowed is None else reachable * allowed)
        subsets = np.zeros((2 ** len(cells), m))
        subsets[:, cells] = (np.arange(len(subsets))[:, None] >> np.arange(len(cells))) % 2
        # [plans so far, sets, M], then one row per plan
        found = mass[:, None, :] * (subsets * world.detection)
        paid = mass.sum(axis=1)[:, None] * (subsets @ world.cost)
        earned = (earned[:, None] + world.reward * found.sum(axis=2) - paid).ravel()
        mass = mass[:, None, :] - found
        located, waited = (
            (total[:, None, :] + now).reshape(-1, m) for total, now in ((located, found), (waited, mass))
        )
        mass = mass.reshape(-1, m)
    # The safe action, as often as it misses.
    mass = mass @ np.linalg.inv(np.eye(m) - kernel * (1.0 - world.safe_detection)) @ kernel
    found = mass * world.safe_detection
    earned = earned + world.reward * found.sum(axis=1) - world.safe_cost * mass.sum(axis=1)
    return earned, located + found, waited
