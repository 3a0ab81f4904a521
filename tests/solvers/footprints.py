"""Tiny worlds whose sensors have footprints, and their optimum by trying every chain of sets of sensors."""

from __future__ import annotations

import itertools

import numpy as np

from trackmdp.world.model import Array, BoolArray, World

__all__ = ["best_of_chains", "tiny_world", "value_of_chains"]


def tiny_world(seed: int) -> World:
    """Four or six cells, two to four sensors with prices of their own, T_max 0 or 1, D from nothing to very dear."""
    rng = np.random.default_rng(seed)
    size = (2, 2) if rng.random() < 0.5 else (2, 3)
    m, s = size[0] * size[1], int(rng.integers(2, 5))
    kernel = rng.random((m, m)) ** rng.choice([1, 4]) * (rng.random((m, m)) < rng.choice([0.5, 0.8, 1.0]))
    kernel *= (1 - rng.choice([0.02, 0.2])) / np.maximum(kernel.sum(axis=1, keepdims=True), 1e-300)
    coverage = rng.random((s, m)) < rng.choice([0.3, 0.5])
    coverage[np.arange(s), rng.integers(m, size=s)] = True
    coverage[0, :2] = True  # never the paper's sensors
    cost = rng.choice([0.0, 0.05, 0.1, 0.25, 0.5]) * (1 + rng.random(s))
    safe_cost = float(cost.sum() * rng.choice([0.0, 0.3, 1.0, 3.0]))
    return World(kernel, size, cost=cost, t_max=int(rng.integers(0, 2)), safe_cost=safe_cost, coverage=coverage)


def value_of_chains(world: World, chains: BoolArray) -> Array:
    """`[M]` the value of `chains` `[M, T+1, S]`, one set after another."""
    earned, located = zip(*(_renewal(world, x, chain) for x, chain in enumerate(chains)), strict=True)
    value: Array = np.linalg.solve(np.eye(world.num_cells) - np.stack(located), np.array(earned))
    return value


def best_of_chains(world: World) -> Array:
    """`[M]` V*, by policy iteration over every chain of sets of sensors."""
    m, s = world.num_cells, world.total_sensors
    subsets = list(itertools.product([False, True], repeat=s))
    chains = np.array(list(itertools.product(subsets, repeat=world.num_choices)))
    tried = [[_renewal(world, x, chain) for chain in chains] for x in range(m)]
    earned = [np.array([each[0] for each in one]) for one in tried]
    located = [np.stack([each[1] for each in one]) for one in tried]
    picks, value = [0] * m, np.full(m, -np.inf)
    while True:
        moves = np.stack([located[x][pick] for x, pick in enumerate(picks)])
        better = np.linalg.solve(np.eye(m) - moves, [earned[x][pick] for x, pick in enumerate(picks)])
        if better.sum() <= value.sum() + 1e-11:
            return value
        value = better
        picks = [int(np.argmax(earned[x] + located[x] @ value)) for x in range(m)]


def _renewal(world: World, x: int, chain: BoolArray) -> tuple[float, Array]:
    """Reward until the target is located again, and where it is then."""
    assert world.coverage is not None
    covers = world.coverage.matrix.toarray()
    earned, located, mass = 0.0, np.zeros(world.num_cells), np.eye(world.num_cells)[x]
    for on in chain:
        mass = mass @ world.kernel
        seen = covers[on].any(axis=0)
        earned += world.reward * mass[seen].sum() - world.cost[on].sum() * mass.sum()
        located, mass = located + mass * seen, mass * ~seen
    mass = mass @ world.kernel
    return earned + (world.reward - world.safe_cost) * mass.sum(), located + mass
