"""Replaying a policy on recorded tracks: by hand, against the environment, and the intervals of its figures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import limited, small_world
from tests.tracks import by_hand, drawn, recorded
from trackmdp.arrays.types import BoolArray
from trackmdp.environment.env import TrackEnv
from trackmdp.policies.policy import Policy
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import ReplayedTracks
from trackmdp.solvers.value import replay

FIGURES = ("aihtr", "accuracy", "sensors_per_step", "safe_per_episode", "expected_length")


def replayed(task: Task, tracks: Tracks, chains: np.ndarray) -> ReplayedTracks:
    return replay(task, tracks, PolicyTable.from_dense(task, chains))


def sensing(*sets: tuple[int, int, list[int]], t_max: int = 1) -> BoolArray:
    """Chains on 3x3 that sense `cells` n misses after locating the target in x, for each (x, n, cells)."""
    chains = np.zeros((9, t_max + 1, 9), dtype=bool)
    for cell, n, cells in sets:
        chains[cell, n, cells] = True
    return chains


CHAINS = sensing((0, 0, [1]), (1, 0, [2, 3]), (1, 1, [5]))


@pytest.mark.parametrize(
    ("track", "reward", "steps", "detections", "sensors", "safe", "length"),
    [
        ([0, 1], 1 - 0.2, 1, 1, 1, 0, 2),  # found at once; the exit step costs nothing
        ([0, 1, 3], 0.8 + (1 - 0.4), 2, 2, 3, 0, 3),
        ([0, 1, 4, 5], 0.8 - 0.4 + (1 - 0.2), 3, 2, 1 + 2 + 1, 0, 4),
        ([0, 1, 4, 4, 4], 0.8 - 0.4 - 0.2 + (1 - 1.8), 4, 2, 4, 1, 5),  # missed twice, then forced
        (
            [0, 1, 4, 4, 4, 5],
            0.8 - 0.4 - 0.2 - 0.8,
            5,
            2,
            4,
            1,
            6,
        ),  # located in 4, where nothing is sensed
        ([0], 0.0, 0, 0, 0, 0, 1),
    ],
)
def test_figures_by_hand(
    track: list[int],
    reward: float,
    steps: int,
    detections: int,
    sensors: int,
    safe: int,
    length: int,
) -> None:
    other = [1, 3]  # a track beside it, which must not count
    both = replayed(recorded(by_hand(track)), by_hand(track, other), CHAINS)
    assert both.totals[0] == pytest.approx([reward, steps, detections, sensors, safe])
    assert both.length.tolist() == [length, 2]
    assert both.totals[1] == pytest.approx([0.6, 1, 1, 2, 0])


def test_a_recording_that_stops_has_no_exit_step() -> None:
    stops = replayed(
        recorded(by_hand([0, 1])), by_hand([0, 1], [0, 1, 4], exits=[False, False]), CHAINS
    )
    assert stops.length.tolist() == [1, 2]
    assert stops.totals[:, 0] == pytest.approx([0.8, 0.4])


def in_the_environment(setting: Recorded, chains: BoolArray, max_steps: int | None) -> np.ndarray:
    """`[K, 6]` reward, steps in the grid, detections, sensors, safe actions, length, stepping `TrackEnv`."""
    count = len(setting.tracks)
    env, policy = TrackEnv(limited(setting, max_steps), count), Policy.from_dense(setting, chains)
    state = env.reset()
    totals, running = torch.zeros(6, count), torch.ones(count, dtype=torch.bool)
    begun = env.snapshot()["rows"]["place"]
    while running.any():
        state = policy(state)
        following = env.step(state)["next"]
        inside = ~following["terminated"].squeeze(-1)
        forced = (state["steps_since_detection"] > setting.t_max) & inside
        found = (following["steps_since_detection"] == 0) & inside
        sensors = state["action"].sum(-1) * (inside & ~forced)
        figures = [
            following["reward"].squeeze(-1),
            inside,
            found,
            sensors,
            forced,
            torch.ones(count),
        ]
        totals += torch.stack(figures) * running
        running &= ~following["done"].squeeze(-1)
        state = following.select(*env.observation_spec)
    return totals[:, begun.argsort()].T.numpy()  # in the order of the tracks


@given(st.integers(0, 2**31), st.integers(0, 3), st.sampled_from([None, 1, 4]), st.floats(0, 1))
def test_figures_are_those_of_the_environment(
    seed: int, t_max: int, max_steps: int | None, density: float
) -> None:
    rng = np.random.default_rng(seed)
    tracks = drawn(small_world(seed=seed).kernel, 30, seed)
    tracks = replace(tracks, exits=rng.random(30) < 0.7).select(tracks.lengths > 1)
    setting = replace(
        recorded(tracks, t_max=t_max, anywhere=False), cost=rng.random(9), safe_cost=0.7
    )
    chains = rng.random((9, t_max + 1, 9)) < density
    ours = replayed(setting, tracks.limited(max_steps), chains)
    stepped = in_the_environment(setting, chains, max_steps)
    np.testing.assert_allclose(
        np.column_stack([ours.totals, ours.length]), stepped, rtol=1e-5, atol=1e-5
    )


@pytest.mark.slow
def test_intervals_cover_the_exact_value_19_times_of_20() -> None:
    world = small_world(t_max=1)
    chains = np.random.default_rng(1).random((9, 2, 9)) < 0.3
    exact, trials = evaluate(world, chains), 400
    covered = dict.fromkeys(["reward_per_step", *FIGURES], 0)
    tracks = drawn(world.kernel, 60 * trials)
    for trial in range(trials):
        mine = np.arange(len(tracks)) // 60 == trial
        for name, interval in (
            replayed(world, part := tracks.select(mine), chains).intervals(part.names).items()
        ):
            truth = (
                exact.aihtr / exact.expected_length
                if name == "reward_per_step"
                else getattr(exact, name)
            )
            assert interval.low is not None
            assert interval.high is not None
            covered[name] += interval.low <= truth <= interval.high
    assert all(count > 0.92 * trials for count in covered.values()), covered
    assert all(
        covered[name] < 0.985 * trials for name in ("aihtr", "reward_per_step", "sensors_per_step")
    ), covered


def test_a_single_track_has_no_interval() -> None:
    alone = replayed(recorded(by_hand([0, 1])), by_hand([0, 1]), CHAINS).intervals(np.zeros(1))
    assert alone["aihtr"].mean == pytest.approx(0.8)
    assert (alone["aihtr"].low, alone["aihtr"].high) == (None, None)


def test_pieces_of_one_path_count_as_one_target() -> None:
    """Every track twice: under names of their own the interval is narrower by √2, under one name it stays."""
    world = small_world(exit_probability=0.05)
    tracks = drawn(world.kernel, 400)
    twice = by_hand(
        *[
            tracks.cells[a:b].tolist()
            for a, b in zip(tracks.first[:-1], tracks.first[1:], strict=True)
        ]
        * 2
    )
    once, doubled = (replayed(world, each, CHAINS) for each in (tracks, twice))
    width: dict[str, float] = {}
    for name, found in (
        ("once", once.intervals(tracks.names)),
        ("one name", doubled.intervals(np.tile(tracks.names, 2))),
        ("own names", doubled.intervals(twice.names)),
    ):
        interval = found["reward_per_step"]
        assert interval.low is not None
        assert interval.high is not None
        assert interval.mean == pytest.approx(once.intervals(tracks.names)["reward_per_step"].mean)
        width[name] = interval.high - interval.low
        assert found["aihtr"].mean == pytest.approx(once.totals[:, 0].mean())
    assert width["one name"] == pytest.approx(width["once"])
    assert width["own names"] == pytest.approx(width["once"] / 2**0.5, rel=0.1)


def test_cells_watched_are_counted_over_all_tracks() -> None:
    """0 > 1 (sensed) > 4: 2 and 3 are sensed, then 5; the other track senses 1, and nothing on its exit step."""
    task, tracks = recorded(by_hand([0])), by_hand([0, 1, 4, 4], [0, 1])
    found = replayed(task, tracks, CHAINS)
    assert found.watched.tolist() == [0, 2, 1, 1, 0, 1, 0, 0, 0]
    assert found.watched.sum() == found.totals[:, 3].sum()
    drawn_sets = replay(task, tracks, PolicyTable(task, probability=0.5))
    assert drawn_sets.watched == pytest.approx(np.full(9, drawn_sets.totals[:, 3].sum() / 9))
