"""Worlds with known answers, and brute force written apart from the solvers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from hypothesis import strategies as st

from tests.solvers.chain import choosable, sees
from trackmdp.arrays.types import Array, BoolArray
from trackmdp.motion.kernels import random_support
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import led
from trackmdp.world.model import World

REFERENCES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "data" / "values.json").read_text(encoding="utf-8")
)
PAPER_REFERENCES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[1] / "data" / "paper_pairs.json").read_text(encoding="utf-8")
)


def searched(world: World, steps: int = 30) -> PolicyTable:
    """The policy of the homotopy, before exchange."""
    return led(Renewal(world, world.motion), steps=steps).table


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
    draw: st.DrawFn,
    *,
    size: int = 2,
    most_t_max: int = 1,
    support: int | None = None,
    misses: bool = False,
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
    kernel *= (1.0 - draw(st.sampled_from([0.02, 0.2]))) / np.maximum(
        kernel.sum(axis=1, keepdims=True), 1e-300
    )
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


def random_tiny_world(rng: np.random.Generator) -> World:
    """Three or four cells, T_max 0 to 4: prices per cell, some of them 0, and D from nothing to very dear."""
    t_max = int(rng.integers(5))
    size = (1, 3) if t_max >= 3 else (2, 2)
    m = size[0] * size[1]
    kernel = rng.random((m, m)) ** rng.choice([1.0, 4.0]) * (
        rng.random((m, m)) < rng.choice([0.5, 0.8, 1.0])
    )
    kernel *= (1.0 - rng.choice([0.02, 0.2])) / np.maximum(
        kernel.sum(axis=1, keepdims=True), 1e-300
    )
    cost = rng.choice([0.1, 0.25, 0.5]) * (1.0 + rng.random(m)) * (rng.random(m) < 0.8)
    safe_cost = float(cost.sum() * rng.choice([0.0, 0.3, 1.0, 30.0]))
    return World(kernel, size, cost=cost, safe_cost=safe_cost, t_max=t_max)


def footprint_world(seed: int) -> World:
    """Four or six cells, two to four sensors with prices of their own, T_max 0 or 1, D from nothing to very dear."""
    rng = np.random.default_rng(seed)
    size = (2, 2) if rng.random() < 0.5 else (2, 3)
    m, s = size[0] * size[1], int(rng.integers(2, 5))
    kernel = rng.random((m, m)) ** rng.choice([1, 4]) * (
        rng.random((m, m)) < rng.choice([0.5, 0.8, 1.0])
    )
    kernel *= (1 - rng.choice([0.02, 0.2])) / np.maximum(kernel.sum(axis=1, keepdims=True), 1e-300)
    coverage = rng.random((s, m)) < rng.choice([0.3, 0.5])
    coverage[np.arange(s), rng.integers(m, size=s)] = True
    coverage[0, :2] = True  # never the paper's sensors
    cost = rng.choice([0.0, 0.05, 0.1, 0.25, 0.5]) * (1 + rng.random(s))
    safe_cost = float(cost.sum() * rng.choice([0.0, 0.3, 1.0, 3.0]))
    t_max = int(rng.integers(0, 2))
    return World(kernel, size, cost=cost, t_max=t_max, safe_cost=safe_cost, coverage=coverage)


def best_of_all(world: World) -> Array:
    """`[Z]` V* where a detection reveals the state: every plan tried from every state until none has a better one."""
    states = range(world.num_states)
    tried = [all_plans(world, z) for z in states]
    picks, value = [0] * world.num_states, np.full(world.num_states, -np.inf)
    while True:
        earned = np.array([options[0][pick] for options, pick in zip(tried, picks, strict=True)])
        located = np.stack([options[1][pick] for options, pick in zip(tried, picks, strict=True)])
        better = np.linalg.solve(np.eye(world.num_states) - located, earned)
        if better.sum() <= value.sum() + 1e-11:
            return value
        value = better
        picks = [int(np.argmax(earned + located @ value)) for earned, located, _ in tried]


Followed: TypeAlias = tuple[Array, Array, Array]
"""Of C plans `[C]` reward up to the next detection, `[C, Z]` where it is, and `[C, Z]` the sum of z_t undetected."""


def all_plans(world: World, z: int) -> Followed:
    """Every plan from state z; a sensor that cannot see the target only costs, and is left out."""
    allowed = choosable(world)[z // world.modes]
    reachable, sets = np.eye(world.num_states)[z], []
    for _ in range(world.num_choices):
        reachable = (reachable @ world.kernel > 0).astype(float)
        cells = np.unique(np.flatnonzero(reachable) // world.modes)
        sensors = np.flatnonzero((sees(world)[:, cells] > 0).any(axis=1) & allowed)
        subsets = np.zeros((2 ** len(sensors), world.total_sensors), dtype=bool)
        subsets[:, sensors] = (np.arange(len(subsets))[:, None] >> np.arange(len(sensors))) % 2
        if world.budget is not None:
            subsets = subsets[subsets.sum(axis=1) <= world.budget]
        sets.append(subsets)
    return followed(world, z, sets)


def followed(world: World, z: int, sets: Sequence[BoolArray]) -> Followed:
    """All plans from state z that take one of `sets` `[C, S]` at each step."""
    states, kernel = world.num_states, world.kernel.toarray()
    cell, price = np.arange(states) // world.modes, np.nan_to_num(world.cost)
    mass, earned = np.eye(states)[[z]], np.zeros(1)
    located, waited = np.zeros((1, states)), np.zeros((1, states))
    for on in sets:
        # [plans so far, sets, Z], then one row per plan
        mass = mass @ kernel
        report = 1.0 - np.prod(1.0 - on[:, :, None] * sees(world), axis=1)[:, cell]
        found = mass[:, None] * report
        paid = mass.sum(axis=1)[:, None] * (on @ price)
        earned = (earned[:, None] + world.reward * found.sum(axis=2) - paid).ravel()
        mass = mass[:, None] - found
        located, waited = (
            (total[:, None] + now).reshape(-1, states)
            for total, now in ((located, found), (waited, mass))
        )
        mass = mass.reshape(-1, states)
    # The safe action, as often as it misses.
    safe = world.safe_detection[cell]
    mass = mass @ np.linalg.inv(np.eye(states) - kernel * (1.0 - safe)) @ kernel
    found = mass * safe
    earned = earned + world.reward * found.sum(axis=1) - world.safe_cost * mass.sum(axis=1)
    return earned, located + found, waited
