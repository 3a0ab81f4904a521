"""The picture shows what happened, in a world where only one thing can."""

from __future__ import annotations

import numpy as np

from trackmdp.reports.picture import LEGEND, draw
from trackmdp.solvers import clocked
from trackmdp.world.kernels import random_support
from trackmdp.world.model import World


def right_mover() -> World:
    """A 3x3 grid in which the target always moves one cell to the right, and leaves at the border."""
    kernel = np.diag([1.0, 1.0, 0.0] * 3, k=1)[:9, :9]
    return World(kernel, 3, cost=np.full(9, 0.1), safe_cost=0.9, t_max=0)


def test_a_detection_by_hand() -> None:
    chains = np.zeros((9, 1, 9), dtype=bool)
    chains[4, 0, [4, 5]] = True
    expected = ["step 1", "· · ·", "· ▪ ●", "· · ·", "", LEGEND, ""]
    assert draw(right_mover(), chains, seed=0).split("\n") == expected


def test_a_miss_by_hand() -> None:
    chains = np.zeros((9, 1, 9), dtype=bool)
    chains[4, 0, 3] = True
    expected = ["step 1", "· · ·", "▪ · ○", "· · ·", "", LEGEND, ""]
    assert draw(right_mover(), chains, seed=0, steps=1).split("\n") == expected


def test_the_safe_action_follows_the_last_free_miss() -> None:
    stay = World(np.eye(9), 3, cost=np.full(9, 0.1), safe_cost=0.9, t_max=0)
    lines = draw(stay, np.zeros((9, 1, 9), dtype=bool), seed=0, steps=3).split("\n")
    assert lines[:4] == [
        "step 1   step 2   step 3",
        "· · ·    ▪ ▪ ▪    · · ·",
        "· ○ ·    ▪ ● ▪    · ○ ·",
        "· · ·    ▪ ▪ ▪    · · ·",
    ]


def test_the_same_seed_draws_the_same_path_and_another_another() -> None:
    kernel = random_support(
        7, support_size=5, radius=1, low_probability=0.15, exit_probability=0.005, border="renormalize", seed=5
    )
    world = World(kernel, 7, cost=np.full(49, 0.16), safe_cost=7.84, t_max=1)
    chains = clocked.solve(world).dense()
    assert draw(world, chains, seed=1) == draw(world, chains, seed=1)
    assert len({draw(world, chains, seed=seed) for seed in range(5)}) == 5
