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
from trackmdp.algos.segments import SegmentBuffer, SensedPaths
from trackmdp.policies.policy import Policy, as_policy
from trackmdp.solvers.path_exchange import parted
from trackmdp.solvers.recorded import replay
from trackmdp.world.tracks import Tracks

M = 9
SETTING = recorded(drawn(small_world(exit_probability=0.2).kernel, 300))


def buffer(steps: int = 3, capacity: int = 10_000, seed: int = 0) -> SegmentBuffer:
    return SegmentBuffer(SETTING, steps, capacity, torch.Generator().manual_seed(seed))


def segments(made: SegmentBuffer) -> list[tuple[int, ...]]:
    return sorted(map(tuple, made.segments().T.tolist()))


def frames(*tracks: list[int], exits: bool = True, envs: int = 1, time: int = 12, max_steps: int | None = None) -> Any:
    return collect(
        setting := recorded(by_hand(*tracks, exits=exits)), Policy.all_on(setting), envs, time, max_steps=max_steps
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


def test_rows_of_workers_are_rows() -> None:
    """Collectors with worker processes stack their batches."""
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    one, stacked = buffer(), buffer()
    one.extend(batch)
    for part in batch.split(8, dim=1):
        stacked.extend(torch.stack([part[:8], part[8:]]))
    assert segments(stacked) == segments(one)


def test_rows_that_are_others_are_not_joined() -> None:
    first, second = (
        collect(SETTING, Policy.all_on(SETTING), 16, 8, seed=0),
        collect(SETTING, Policy.all_on(SETTING), 16, 8, seed=1),
    )
    made, apart = buffer(), [buffer(), buffer()]
    for batch, alone in zip((first, second), apart, strict=True):
        made.extend(batch)
        alone.extend(batch)
    assert segments(made) == sorted(segments(apart[0]) + segments(apart[1]))


def test_a_step_that_was_not_fully_sensed_breaks_a_segment() -> None:
    batch = frames([0, 1, 2, 3, 4, 5, 6, 7, 8], time=8)
    batch["action"][0, 4, 0] = False
    made = buffer()
    made.extend(batch)
    assert segments(made) == [(0, 1, 2, 3), (1, 2, 3, 4), (5, 6, 7, 8)]


def test_nothing_is_read_that_was_not_sensed() -> None:
    """Rewards, histories, and cells after steps that did not sense all."""
    rng = torch.Generator().manual_seed(0)
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    batch["action"] &= torch.rand(*batch.shape, 1, generator=rng) < 0.8
    poisoned = batch.clone()
    for place in (poisoned, poisoned["next"]):
        place["action_history"] = torch.rand(place["action_history"].shape, generator=rng) < 0.5
    poisoned["next", "reward"] = torch.randn(16, 40, 1, generator=rng)
    missed = ~batch["action"].all(-1)
    poisoned["next", "last_cell"][missed] = torch.randint(9, (int(missed.sum()),), generator=rng)
    clean, other = buffer(), buffer()
    clean.extend(batch)
    other.extend(poisoned)
    assert segments(clean) == segments(other)
    assert len(clean) > 100


def test_a_recording_has_one_name_however_often_it_is_followed() -> None:
    """Two recordings, in turn, and at the end a third; where the frames stop, a path is cut off."""
    made = SensedPaths(M)
    made.extend(frames([0, 1, 2, 3], [4, 5], time=40))
    tracks = made.tracks()
    pieces = [tuple(piece) for piece in np.split(tracks.cells, tracks.first[1:-1])]
    named = set(zip(pieces, tracks.names.tolist(), strict=True))
    assert len(tracks) > 8
    assert {piece for piece, _ in named} >= {(0, 1, 2, 3), (4, 5)}
    assert len(named) == len(set(pieces)) == len(set(tracks.names.tolist()))


def test_what_judges_is_not_learned_from() -> None:
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    whole, learned = buffer(), SegmentBuffer(SETTING, 3, 10_000, torch.Generator().manual_seed(0), judge=1)
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


def test_paths_start_everywhere_and_are_whole_segments() -> None:
    made = buffer()
    made.extend(collect(SETTING, Policy.all_on(SETTING), 16, 60))
    seen = set(segments(made))
    cells = made.paths(40 * M, 3)
    assert torch.bincount(cells[0], minlength=M).tolist() == [40] * M
    assert set(map(tuple, cells.T.tolist())) <= seen
    assert made.paths(50, 1).shape == (2, 50)


def test_first_moves_have_the_proportions_seen() -> None:
    made = buffer(steps=1)
    made.extend(frames([0, 1], [0, 2], [0, 1], [0, 3], time=8))
    cells = made.paths(80 * M, 1)
    left = torch.bincount(cells[1][cells[0] == 0], minlength=M + 1)
    assert left[[1, 2, 3]].tolist() == [40, 20, 20]


def test_outside_follows_on_a_cell_without_segments() -> None:
    made = buffer()
    made.extend(frames([0, 1, 2, 3], time=4))
    cells = made.paths(M, 3)
    assert {int(path[0]): path[1:].tolist() for path in cells.T}[5] == [M, M, M]


def test_the_oldest_segments_go_first() -> None:
    made = buffer(steps=1, capacity=2)
    made.extend(frames([0, 1, 2, 3], time=4))
    assert segments(made) == [(2, 3), (3, 9)]


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
    for part in collect(setting := recorded(tracks), Policy.all_on(setting), 5, 24, seed=seed).split(time, dim=1):
        made.extend(part)
    lines = [[*tracks.cells[a:b], *[M] * steps] for a, b in zip(tracks.first[:-1], tracks.first[1:], strict=True)]
    pieces = {tuple(map(int, line[i : i + steps + 1])) for line in lines for i in range(len(line) - steps)}
    assert set(segments(made)) <= pieces


def test_a_saved_buffer_goes_on_the_same() -> None:
    batch = collect(SETTING, Policy.all_on(SETTING), 16, 40)
    one, other = buffer(seed=3), buffer(seed=3)
    one.extend(batch[:, :17])
    other.load_state_dict(one.state_dict())
    for made in (one, other):
        made.extend(batch[:, 17:])
    assert segments(one) == segments(other)
    assert torch.equal(one.paths(50, 3), other.paths(50, 3))


@pytest.mark.slow
def test_what_depends_on_more_than_the_cell_is_learned_from_whole_paths_only() -> None:
    """The target goes 3, 4, 5, 4, 3, 4 ...: two steps after 3 it is in 5, as moves alone do not tell.

    Sensing 4 costs nearly as much as it earns. Whole paths say: leave 4 out and wait in 5 (and 3), .4 in two steps.
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
        words = ["algo.updates=300", "algo.updates_per_iteration=100", "algo.batch_size=2048", "algo.hidden=32"]
        learner = algorithm("hindsight", setting, *words)
        for part in collect(setting, learner.policy, 32, 128).split(8, dim=1):
            learner.step(part)
        while learner.step(None)["updates"] < 300:
            pass
        policy = as_policy(setting, learner.actor)
        earned[markov] = replay(setting, tracks, policy).intervals(tracks.names)["reward_per_step"].mean
        if not markov:
            assert policy.dense()[[3, 5]].nonzero()[1].tolist() == [1, 1]
    assert earned[False] > 0.19
    assert earned[True] < 0.11
