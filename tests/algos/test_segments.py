"""Path segments: whole, as sensed, whatever the batches they came in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import algorithm, collect, headings, small_world
from tests.tracks import by_hand, drawn, recorded
from trackmdp.algos.estimates.path_plans import parted
from trackmdp.algos.segments import SegmentBuffer, SensedPaths
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.recordings.tracks import Tracks
from trackmdp.solvers.value import replay

M = 9
SETTING = recorded(drawn(small_world(exit_probability=0.2).kernel, 300))


def buffer(steps: int = 3, capacity: int = 10_000, seed: int = 0) -> SegmentBuffer:
    return SegmentBuffer(SETTING, steps, capacity, torch.Generator().manual_seed(seed))


def segments(made: SegmentBuffer) -> list[tuple[int, ...]]:
    return sorted(map(tuple, made.segments().T.tolist()))


def frames(
    *tracks: list[int],
    exits: bool = True,
    envs: int = 1,
    time: int = 12,
    max_steps: int | None = None,
) -> Any:
    return collect(
        setting := recorded(by_hand(*tracks, exits=exits), anywhere=False),
        Policy.all_on(setting),
        envs,
        time,
        max_steps=max_steps,
    )


def test_segments_are_those_of_the_track_by_hand() -> None:
    made = buffer()
    made.extend(frames([0, 1, 2, 3], time=4))
    once = [(0, 1, 2, 3), (1, 2, 3, 9), (2, 3, 9, 9), (3, 9, 9, 9)]
    assert segments(made) == once
    made.extend(frames([0, 1, 2, 3], time=4))  # the same row has begun the track anew
    assert segments(made) == sorted(once * 2)


def test_a_recording_that_stops_ends_its_segments() -> None:
    made = buffer()
    made.extend(frames([0, 1, 2, 3, 4], exits=False, time=8))
    assert segments(made) == [(0, 1, 2, 3)] * 2 + [(1, 2, 3, 4)] * 2
    limited = buffer()
    limited.extend(frames([0, 1, 2, 3, 4, 5, 6, 7], time=8, max_steps=4))
    assert segments(limited) == [(0, 1, 2, 3)] * 2 + [(1, 2, 3, 4)] * 2


def test_where_all_recordings_are_short_those_that_exit_are_no_selection() -> None:
    """None shows three steps: the one that stops counts as if the target left there."""
    both = by_hand([0, 1], [3, 4, 5], exits=[True, False])
    setting, made = recorded(both, anywhere=False), buffer()
    made.extend(collect(setting, Policy.all_on(setting), 2, 8))
    assert {*segments(made)} == {(0, 1, 9, 9), (1, 9, 9, 9), (3, 4, 5, 9), (4, 5, 9, 9)}


@pytest.mark.parametrize("cut", [1, 2, 5, 20])
def test_batches_in_pieces_give_what_they_give_in_one(cut: int) -> None:
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    whole, pieces = buffer(), buffer()
    whole.extend(batch)
    for part in batch.split(cut, dim=1):
        pieces.extend(part)
    assert segments(pieces) == segments(whole)
    assert len(whole) > 500


@pytest.mark.parametrize("memory", ["displacement", "two_displacements"])
def test_segments_of_keys_are_those_of_the_environment(memory: str) -> None:
    """With all sensors on, step by step; a part of a batch makes the same."""
    world = headings(memory=memory)
    batch = collect(world, Policy.all_on(world), 8, 30)
    made = SegmentBuffer(world, 2, 10_000, torch.Generator())
    for part in batch.split(7, dim=1):
        made.extend(part)
    key, after, done = batch["key"], batch["next", "key"], batch["next", "done"].squeeze(-1)
    after = torch.where(done, world.num_keys, after)
    seen = []
    for row in range(8):
        for t in range(30):
            if done[row, t]:
                seen.append((int(key[row, t]), world.num_keys, world.num_keys))
            elif t < 29:
                seen.append((int(key[row, t]), int(key[row, t + 1]), int(after[row, t + 1])))
    assert segments(made) == sorted(seen)
    assert len({first for first, *_ in seen}) > 40


def test_rows_go_on_in_the_next_batch() -> None:
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    one, parted = buffer(), buffer()
    one.extend(batch)
    for part in batch.split(8, dim=1):
        parted.extend(part)
    assert segments(parted) == segments(one)


def test_rows_that_are_others_are_not_joined() -> None:
    first, second = (
        collect(SETTING, Policy.all_on(SETTING), 16, 8, seed=0),
        collect(SETTING, Policy.all_on(SETTING), 16, 8, seed=1),
    )
    made, apart = buffer(), [buffer(), buffer()]
    for batch, alone in zip((first, second), apart, strict=True):
        made.extend(batch)
        alone.extend(batch)
    # Equal paths of both, of which one stops earlier, are one.
    assert set(segments(made)) == set(segments(apart[0]) + segments(apart[1]))


def test_a_recording_has_one_name_however_often_it_is_followed() -> None:
    """Two recordings, in turn, and at the end a third; where the frames stop, a path is cut off."""
    made = SensedPaths(SETTING)
    made.extend(frames([0, 1, 2, 3], [4, 5], time=40))
    tracks = made.tracks()
    pieces = [tuple(piece) for piece in np.split(tracks.cells, tracks.first[1:-1])]
    named = set(zip(pieces, tracks.names.tolist(), strict=True))
    assert len(tracks) > 8
    assert {piece for piece, _ in named} >= {(0, 1, 2, 3), (4, 5)}
    assert len(named) == len(set(pieces)) == len(set(tracks.names.tolist()))


@pytest.mark.parametrize("road", [0, 8])
def test_a_recording_has_one_name_also_where_sensors_miss(road: int) -> None:
    """Of 24 cells in a row of its own, where one cell in ten is unknown; perhaps all leave by one road."""
    rng, size = np.random.default_rng(0), 10
    steps = np.cumsum(rng.integers(-1, 2, (size - 1, 24)), axis=1)
    rows = size * np.arange(size - 1)[:, None] + np.clip(5 + steps, 0, size - 1)
    last = np.broadcast_to(size * (size - 1) + np.arange(road), (size - 1, road))
    tracks = by_hand(*np.concatenate([rows, last], axis=1))
    setting = recorded(tracks, size=size, anywhere=False, detection=0.9)
    made = SensedPaths(setting)
    made.extend(collect(setting, Policy.all_on(setting), 32, 7 * 25))
    found = made.tracks()
    row = found.cells[found.first[:-1]] // size
    kept = found.lengths == 24 + road
    pairs, times = np.unique([row[kept], found.names[kept]], axis=1, return_counts=True)
    most = [times[pairs[0] == each].max() for each in range(size - 1)]
    assert sum(most) > 0.95 * kept.sum() > 140
    assert len(set(pairs[1])) == pairs.shape[1]  # no name is that of two recordings


def test_a_path_that_only_begins_as_another_is_left_out() -> None:
    """It would count as one more recording, and judge plans by the recording that they were learned from."""
    made = SensedPaths(SETTING)
    batch = frames([0, 1, 2, 3, 4, 5], [0, 1, 4, 7], envs=8, time=40)
    made.extend(batch[:, :3])
    begun = made.tracks()
    assert set(map(tuple, np.split(begun.cells, begun.first[1:-1]))) == {(0, 1, 2, 3), (0, 1, 4, 7)}
    made.extend(batch[:, 3:])
    assert set(pieces(made.tracks())) == {(0, 1, 2, 3, 4, 5), (0, 1, 4, 7)}
    assert made.tracks().exits.all()


def test_what_judges_is_not_learned_from() -> None:
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    whole, learned = (
        buffer(),
        SegmentBuffer(SETTING, 3, 10_000, torch.Generator().manual_seed(0), judge=1),
    )
    for made in (whole, learned):
        made.extend(batch)
    left, judging = parted(learned.tracks(), 1)
    cut = [segments_of(part) for part in (left, judging)]
    assert segments(learned) == cut[0]
    assert segments(whole) == sorted(cut[0] + cut[1])
    assert len(cut[1]) > 50


def segments_of(tracks: Tracks) -> list[tuple[int, ...]]:
    """All runs of four cells, after an exit filled with M."""
    found = []
    for begin, end, exits in zip(tracks.first[:-1], tracks.first[1:], tracks.exits, strict=True):
        line = [*tracks.cells[begin:end].tolist(), *[M] * (3 * bool(exits))]
        found += [tuple(line[i : i + 4]) for i in range(len(line) - 3)]
    return sorted(found)


def test_the_oldest_batches_go_first() -> None:
    made = buffer(steps=1, capacity=2)
    for part in frames([0, 1, 2, 3], time=4).split(2, dim=1):
        made.extend(part)
    assert segments(made) == [(2, 3), (3, 9)]


def test_unknown_cells_are_drawn_as_the_kernel_explains_them() -> None:
    """In the middle of 0 ? 2 the target was in 1, its only way; out of 0 ? 8 it was in 4, where no sensor is."""
    task = recorded(by_hand(*[[0, 1, 2], [0, 4, 8]] * 40))
    blind = replace(task, cost=np.where(np.arange(9) == 4, np.nan, 0.2), detection=0.7)
    made = SensedPaths(blind)
    made.extend(collect(blind, Policy.all_on(blind), 64, 60))
    tracks = made.tracks()
    pieces = [tuple(piece) for piece in np.split(tracks.cells, tracks.first[1:-1])]
    whole = [piece for piece, exits in zip(pieces, tracks.exits, strict=True) if exits]
    for path in ((0, 1, 2), (0, 4, 8)):
        assert whole.count(path) > 0.4 * len(whole)


def pieces(tracks: Tracks) -> list[tuple[int, ...]]:
    """The cells of each track that exits."""
    each = np.split(tracks.cells, tracks.first[1:-1])
    return [tuple(cells) for cells, exits in zip(each, tracks.exits.tolist(), strict=True) if exits]


def test_unknown_cells_follow_the_heading() -> None:
    """From 4 the target goes right or down, whichever it did before; by the cell alone half of the draws are wrong."""
    paths = [[3, 4, 5, 8], [1, 4, 7, 8]]
    task = replace(recorded(by_hand(*paths * 40)), detection=0.6, markov=False)
    made = SensedPaths(task)
    made.extend(collect(task, Policy.all_on(task), 256, 40))
    found = pieces(made.tracks())
    assert sum(list(path) in paths for path in found) > 0.98 * len(found)


def test_a_single_cell_may_be_unknown() -> None:
    """Of 0 ? 2 it is 1, where no sensor is."""
    cost = np.where(np.arange(9) == 1, np.nan, 0.2)
    task = replace(recorded(by_hand([0, 1, 2])), cost=cost, markov=False)
    made = SensedPaths(task)
    made.extend(collect(task, Policy.all_on(task), 1, 3))
    assert pieces(made.tracks()) == [(0, 1, 2)]


@pytest.mark.parametrize("cut", [1, 7, 40])
def test_misses_of_the_safe_action_are_steps(cut: int) -> None:
    """The one path there is comes whole out of its pieces, however often the safe action missed on it."""
    path = (0, 1, 2, 5, 8, 7, 6, 3)
    task = replace(recorded(by_hand(list(path))), detection=0.5, safe_detection=0.4, markov=False)
    made = SensedPaths(task)
    for batch in collect(task, Policy.all_on(task), 64, 40).split(cut, dim=1):
        made.extend(batch)
        again = SensedPaths(task)
        again.load_state_dict(made.state_dict())
        made = again
    found = pieces(made.tracks())
    assert len(found) > 200
    assert set(found) == {path}


def test_only_observations_are_read() -> None:
    """Rewards, and sets of steps without a miss, are not."""
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    poisoned = batch.clone()
    poisoned["next", "reward"] = torch.randn(16, 40, 1)
    poisoned["action_history"] = torch.rand(batch["action_history"].shape) < 0.5
    clean, other = buffer(), buffer()
    clean.extend(batch)
    other.extend(poisoned)
    assert segments(clean) == segments(other)
    assert len(clean) > 100


def test_moves_are_all_of_the_segments() -> None:
    """Also those that begin no segment, as the last one of a recording."""
    made = buffer()
    made.extend(frames([0, 1, 2, 8], exits=False, time=3))
    start, end = made.moves()
    assert list(zip(start.tolist(), end.tolist(), strict=True)) == [(0, 1), (1, 2), (2, 8)]


@given(st.integers(0, 2**31), st.integers(1, 5), st.integers(1, 12))
def test_segments_are_pieces_of_tracks(seed: int, steps: int, time: int) -> None:
    tracks = drawn(small_world(exit_probability=0.2).kernel, 20, seed)
    made = buffer(steps)
    for part in collect(
        setting := recorded(tracks), Policy.all_on(setting), 5, 24, seed=seed
    ).split(time, dim=1):
        made.extend(part)
    lines = [
        [*tracks.cells[a:b], *[M] * steps]
        for a, b in zip(tracks.first[:-1], tracks.first[1:], strict=True)
    ]
    pieces = {
        tuple(map(int, line[i : i + steps + 1])) for line in lines for i in range(len(line) - steps)
    }
    assert set(segments(made)) <= pieces


def test_a_saved_buffer_goes_on_the_same() -> None:
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    one, other = buffer(seed=3), buffer(seed=3)
    one.extend(batch[:, :17])
    other.load_state_dict(one.state_dict())
    for made in (one, other):
        made.extend(batch[:, 17:])
    assert segments(one) == segments(other)
    assert torch.equal(one.sample(50), other.sample(50))


@pytest.mark.slow
def test_what_depends_on_more_than_the_cell_is_learned_from_whole_paths_only() -> None:
    """The target goes 3, 4, 5, 4, 3, 4 ...: two steps after 3 it is in 5, as moves alone do not tell.

    Sensing 4 costs nearly as much as it earns. Whole paths say: in 5 leave 4 out and wait, .4 in two steps; and in 3
    wait as well, or sense 4 for .1 and then, certain after 3, 5 for .4: .9 in four steps in all. Or the same with 3 and
    5 the other way round.
    Put together from moves, 5 is as likely as 3, and at .5 neither is worth .6: what is left is 4, at .1 a step.
    """
    rng = np.random.default_rng(0)
    lengths = rng.geometric(0.02, size=400) + 3
    tracks = by_hand(*[([3, 4, 5, 4] * length)[2 * (length % 2) :][:length] for length in lengths])
    cost = np.full(9, 0.6)
    cost[4] = 0.9
    earned = {}
    for markov in (False, True):
        setting = replace(recorded(tracks, markov=markov), cost=cost, safe_cost=5.0)
        words = [
            "algo.updates=300",
            "algo.updates_per_iteration=100",
            "algo.batch_size=2048",
            "algo.hidden=32",
        ]
        learner = algorithm("hindsight", setting, *words)
        for part in collect(setting, learner.policy, 32, 128).split(8, dim=1):
            learner.step(part)
        while learner.step(None)["updates"] < 300:
            pass
        policy = as_policy(setting, learner.actor)
        earned[markov] = (
            replay(setting, tracks, policy).intervals(tracks.names)["reward_per_step"].mean
        )
        if not markov:
            waits = [(policy.dense()[end].nonzero()[0] == [1]).all() for end in (3, 5)]
            assert any(waits)
    assert earned[False] > 0.21
    assert earned[True] < 0.11
