"""Stone Soup follows our policy on its sensors, and sees what our simulation sees."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import small_world
from tests.tracks import by_hand
from trackmdp.episodes.episode import Episode
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.world.group import Group

pytest.importorskip("stonesoup", reason="needs the extra: pip install 'trackmdp[stonesoup]'")

from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.state import State
from stonesoup.types.track import Track
from stonesoup.types.update import Update
from trackmdp_stone_soup.following import follow, gospa, seen_of
from trackmdp_stone_soup.places import Places, paths_of, tracks_of
from trackmdp_stone_soup.sensors import CellSensor, PolicySensorManager

WORLD = small_world(t_max=1)
PLACES = Places.of(WORLD, side=100.0)


def manager(policy: Policy) -> PolicySensorManager:
    return PolicySensorManager(policy=policy, places=PLACES, platforms=set(CellSensor.grid(PLACES)))


def walk(*points: tuple[float, float], exits: bool = False) -> GroundTruthPath:
    states = [GroundTruthState(point, timestamp=PLACES.time(t)) for t, point in enumerate(points)]
    states[-1].metadata["exits"] = exits
    return GroundTruthPath(states)


def test_it_sees_what_the_simulation_sees() -> None:
    """20 episodes of Q_MDP's policy: the same reports, sets and rewards, misses and safe actions among them."""
    policy = tm.solve(WORLD, "qmdp").policy
    episodes = tm.simulate(WORLD, policy, 20, seed=1)
    follower, forced = manager(policy), 0
    for episode, path in zip(episodes, paths_of(episodes, PLACES), strict=True):
        found = follow(follower, path)
        assert found.located.tolist() == episode.located.tolist()
        assert found.reward == pytest.approx(episode.reward, abs=1e-6)
        safe = episode.misses > WORLD.t_max
        assert found.action[safe].all()
        assert (found.action[~safe] == episode.action[~safe]).all()
        forced += int(safe.sum())
    assert forced > 3


def test_where_cells_lie() -> None:
    """3 x 3 cells of 100 m: cell 5 is in row 1, column 2; borders belong to the cell behind them."""
    assert PLACES.centre(5).tolist() == [250.0, 150.0]
    assert [
        PLACES.cell(State(point))
        for point in ([250, 150], [200, 100], [199.9, 100], [300, 0], [-1, 0])
    ] == [
        5,
        5,
        4,
        9,
        9,
    ]
    moving = Places(3, 3, mapping=(0, 2))  # x, its velocity, y, its velocity
    assert moving.cell(State([2.5, 9.0, 0.5, 9.0])) == 2


def test_tracks_become_paths_and_come_back() -> None:
    tracks = by_hand([0, 1, 4], [8, 8], exits=True)
    paths = paths_of(tracks, PLACES)
    assert [[state.metadata["cell"] for state in path] for path in paths] == [[0, 1, 4], [8, 8]]
    assert paths[0][2].timestamp - paths[0][0].timestamp == timedelta(seconds=2)
    again = tracks_of(paths, PLACES)
    assert all(
        (getattr(again, name) == getattr(tracks, name)).all()
        for name in ("cells", "first", "exits")
    )


def test_a_path_is_cut_where_it_leaves_the_grid() -> None:
    tracks = tracks_of([walk((50, 50), (150, 50), (400, 50), (50, 50)), walk((50, 250))], PLACES)
    assert (tracks.cells.tolist(), tracks.first.tolist(), tracks.exits.tolist()) == (
        [0, 1, 6],
        [0, 2, 3],
        [True, False],
    )
    with pytest.raises(UserError, match=r"paths\[0\]: expected a path that begins in the grid"):
        tracks_of([walk((400, 50))], PLACES)


def test_a_step_by_hand() -> None:
    """All off from cell 0: missed twice, then the safe action; the last state is the exit's, free of cost."""
    off = Policy(WORLD, probability=0.0)
    found = follow(manager(off), walk((50, 50), (150, 50), (150, 50), (250, 50), exits=True))
    assert found.located.tolist() == [False, False, True, False]
    assert found.reward == pytest.approx([0.0, 0.0, 1.0 - 9 * 0.2, 0.0])
    assert [state.state_vector.ravel().tolist() for state in found.track] == [[50, 50]] * 3 + [
        [250, 50]
    ]


def test_gospa_by_hand() -> None:
    """Errors 0, 100 and 500 m, cutoff 300 m, p = 2: 0, 100, and c = (c²/2 + c²/2)^(1/2) for one missed, one false."""
    path = walk((50, 50), (150, 50), (250, 50))
    states = [
        State(point, timestamp=PLACES.time(t))
        for t, point in enumerate([(50, 50), (50, 50), (250, 550)])
    ]
    found = gospa([Track(states)], [path], c=300.0)
    assert found["distance"] == pytest.approx((0 + 100 + 300) / 3)
    assert found["localisation"] == pytest.approx(100**2 / 3)
    assert found["missed"] == found["false"] == pytest.approx(300**2 / 2 / 3)


def test_gospa_of_two_targets_by_hand() -> None:
    """Off by 100 m in step 1; located in step 2, in which the other one has left; cutoff 150 m, p = 2.

    The first target walks 0 > 1 > 2, missed and then located; the second stays in 8, located, and leaves.
    """
    episode = Episode(
        *(0, 0, 0),
        start=np.array([0, 8]),
        misses=np.array([[0, 0], [1, 0]]),
        action=np.zeros((2, 9), dtype=bool),
        target=np.array([[1, 8], [2, 9]]),
        located=np.array([[False, True], [True, False]]),
        reward=np.zeros(2),
        terminated=False,
    )
    tracks = seen_of(episode, PLACES)
    assert [[PLACES.cell(state) for state in track] for track in tracks] == [[0, 0, 2], [8, 8]]
    assert [isinstance(state, Update) for state in tracks[0]] == [True, False, True]
    found = gospa(tracks, paths_of(episode.singles(), PLACES), c=150.0)
    assert found["distance"] == pytest.approx((0 + 100 + 0) / 3)
    assert found["missed"] == found["false"] == 0
    # One that goes on after its target has left: c²/2 as a false one, and c²/2 a step for the one that none follows.
    longer = Track([*tracks[1], State(PLACES.centre(8), timestamp=PLACES.time(2))])
    wrong = gospa([longer], paths_of(episode.singles(), PLACES), c=150.0)
    assert wrong["missed"] == pytest.approx(150**2 / 2 * (1 + 1 + 1) / 3)
    assert wrong["false"] == pytest.approx(150**2 / 2 / 3)


def test_tracks_of_simulated_groups_end_with_their_targets() -> None:
    """All sensors on: every track is its target's path, and GOSPA is 0."""
    group = Group([WORLD, WORLD, WORLD])
    for episode in tm.simulate(group, Policy.all_on(WORLD), 5, seed=3, merge="union"):
        tracks, paths = seen_of(episode, PLACES), paths_of(episode.singles(), PLACES)
        assert [len(each) for each in tracks] == [len(each) for each in paths]
        assert gospa(tracks, paths)["distance"] == 0.0


def test_a_policy_that_draws_is_refused() -> None:
    with pytest.raises(UserError, match="policy: expected a deterministic one of the last cell"):
        manager(Policy(WORLD, probability=0.5))


def test_sensors_of_several_cells_are_refused() -> None:
    wide = tm.World(
        WORLD.kernel,
        3,
        cost=0.2,
        t_max=1,
        coverage=np.array([[1.0] * 4 + [0.0] * 5, [0.0] * 4 + [1.0] * 5]),
    )
    with pytest.raises(UserError, match="one sensor a cell"):
        manager(Policy(wide, probability=0.0))


def test_two_tracks_share_the_sensors() -> None:
    policy = tm.solve(WORLD, "qmdp").policy
    both = manager(policy)
    tracks = [
        follow(both, walk(PLACES.centre(cell), PLACES.centre(cell))).track[:1] for cell in (0, 8)
    ]
    for sensor in both.sensors:
        sensor.timestamp = PLACES.start
    (switched,) = both.choose_actions([Track(states) for states in tracks], PLACES.time(1))
    on = {sensor.cell for sensor, (action,) in switched.items() if action.target_value}
    dense = policy.dense()
    assert on == set(np.flatnonzero(dense[0, 0] | dense[8, 0]))
