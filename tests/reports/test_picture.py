"""The picture shows what happened, in a world where only one thing can."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from trackmdp.environment.render import PICTURE_LEGEND
from trackmdp.episodes.batch import Episodes
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.player import draw_picture
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World


def right_mover() -> World:
    """A 3x3 grid in which the target always moves one cell to the right, and leaves at the border."""
    kernel = np.diag([1.0, 1.0, 0.0] * 3, k=1)[:9, :9]
    return World(kernel, 3, cost=np.full(9, 0.1), safe_cost=0.9, t_max=0)


def from_the_middle(world: World, on: np.ndarray) -> Episode:
    return next(
        episode
        for episode in simulate(world, Policy.from_dense(world, on), 50)
        if episode.start == 4
    )


def test_a_detection_by_hand() -> None:
    on = np.zeros((9, 1, 9), dtype=bool)
    on[4, 0, [4, 5]] = True
    expected = ["step 1", "· · ·", "· ▪ ●", "· · ·", "", PICTURE_LEGEND, ""]
    assert draw_picture([from_the_middle(right_mover(), on)], right_mover()).split("\n") == expected


def test_a_miss_by_hand() -> None:
    on = np.zeros((9, 1, 9), dtype=bool)
    on[4, 0, 3] = True
    expected = ["step 1", "· · ·", "▪ · ○", "· · ·", "", PICTURE_LEGEND, ""]
    assert (
        draw_picture([from_the_middle(right_mover(), on)], right_mover(), steps=1).split("\n")
        == expected
    )


def test_the_safe_action_follows_the_last_free_miss() -> None:
    stay = World(np.eye(9), 3, cost=np.full(9, 0.1), safe_cost=0.9, t_max=0, max_steps=4)
    lines = draw_picture(
        [from_the_middle(stay, np.zeros((9, 1, 9), dtype=bool))], stay, steps=3
    ).split("\n")
    assert lines[:4] == [
        "step 1   step 2   step 3",
        "· · ·    ▪ ▪ ▪    · · ·",
        "· ○ ·    ▪ ● ▪    · ○ ·",
        "· · ·    ▪ ▪ ▪    · · ·",
    ]


def test_drawn_is_the_first_that_lasts_or_the_longest() -> None:
    world = World(np.eye(9) * 0.8, 3, cost=0.1, t_max=0)
    episodes: Episodes = simulate(world, Policy.all_on(world), 40)
    lasting = next(episode for episode in episodes if len(episode) > 6)
    assert draw_picture(episodes, world) == draw_picture([lasting], world)
    short = [episode for episode in episodes if len(episode) <= 6]
    assert draw_picture(short, world) == draw_picture([max(short, key=len)], world)
    assert draw_picture(short[:1], world) != draw_picture([lasting], world)


def test_of_a_large_grid_the_part_around_the_target_is_drawn() -> None:
    world = World(sparse.eye_array(40 * 50) * 0.9, (40, 50), cost=0.1, t_max=0)
    episode = simulate(world, Policy.all_on(world), 1, seed=3)[0]
    row, column = divmod(int(episode.target[0]), 50)
    *frames, empty, where, legend, _ = draw_picture([episode], world, steps=1).split("\n")
    assert (empty, legend) == ("", PICTURE_LEGEND)
    top, left = min(max(row - 10, 0), 19), min(max(column - 10, 0), 29)
    assert where == (f"rows {top + 1} to {top + 21} of 40, columns {left + 1} to {left + 21} of 50")
    assert frames[0] == "step 1"
    assert [len(line.split()) for line in frames[1:]] == [21] * 21
    assert frames[1 + row - top].split()[column - left] == "●"
    assert sum(line.count("●") for line in frames) == 1
