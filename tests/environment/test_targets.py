"""Recorded targets in the environment: they go along their tracks, each in its turn."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from tests.acting import RandomSubset
from tests.helpers import Watched, limited, small_world
from tests.tracks import by_hand, drawn, recorded
from trackmdp.environment.env import TrackEnv
from trackmdp.seeding import generator

TRACKS = by_hand([0, 1, 2], [3, 4], [5, 6, 7, 8], exits=[True, True, False])


def rollout(env: TrackEnv, steps: int, policy: Any = None) -> list[Any]:
    rows, frames = env.reset(), []
    policy = policy or RandomSubset(env.num_cells, generator(0, "policy"))
    for _ in range(steps):
        frame, rows = env.step_and_maybe_reset(policy(rows))
        frames.append(frame)
    return frames


def all_on(rows: TensorDict) -> TensorDict:
    return rows.set("action", torch.ones_like(rows["action_history"][..., 0, :]))


def followed(env: Watched, steps: int) -> list[list[tuple[int, ...]]]:
    """Per row, the cells of each episode, M for the exit, `()` closing one that was truncated."""
    paths: list[list[tuple[int, ...]]] = [[] for _ in range(env.num_envs)]
    now: list[tuple[int, ...]] = [()] * env.num_envs
    for frame in rollout(env, steps, all_on):
        after = frame["next"]
        for row in range(env.num_envs):
            now[row] = (now[row] or (int(frame["target"][row]),)) + (int(after["target"][row]),)
            if after["done"][row]:
                assert bool(after["terminated"][row]) == (now[row][-1] == env.num_cells)
                paths[row].append(now[row])
                now[row] = ()
    return paths


def test_every_track_is_replayed_from_its_first_cell_to_its_end() -> None:
    env = Watched(recorded(TRACKS), 1, seed=1)
    (paths,) = followed(env, 9 * 20)
    expected = {(0, 1, 2, 9), (3, 4, 9), (5, 6, 7, 8)}
    assert set(paths) == expected
    rounds = [paths[begin : begin + 3] for begin in range(0, len(paths) - 2, 3)]
    assert all(set(each) == expected for each in rounds)  # each once before any comes again
    assert len({tuple(each) for each in rounds}) > 1


def test_rows_share_the_tracks_out_among_them() -> None:
    env = TrackEnv(recorded(by_hand(*[[cell, cell] for cell in range(9)], exits=False)), 4, seed=0)
    begun = [int(cell) for frame in rollout(env, 9) for cell in frame["last_cell"]]
    assert [sorted(begun[i : i + 9]) for i in range(0, 36, 9)] == [list(range(9))] * 4


def test_starts_anywhere_are_all_points_that_have_a_next() -> None:
    env = TrackEnv(recorded(TRACKS, anywhere=True), 8, seed=0)
    assert sorted(env.reset()["last_cell"].tolist()) == [0, 1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    ("anywhere", "max_steps", "begins"),
    [(None, 2, "anywhere"), (None, None, "first"), (False, 2, "first"), (True, 2, "anywhere")],
)
def test_where_episodes_are_cut_they_begin_anywhere_unless_told(
    anywhere: bool | None, max_steps: int | None, begins: str
) -> None:
    """Else what comes after the first `max_steps` of a track would not be learned from."""
    problem = limited(recorded(TRACKS, anywhere=anywhere), max_steps)
    starts = set(problem.sampled().first.tolist())
    first = set(TRACKS.first[:-1].tolist())
    assert starts == first if begins == "first" else starts > first
    assert problem.sampled(held_out=True).first.tolist() == problem.held_out.first[:-1].tolist()


@pytest.mark.parametrize("max_steps", [None, 2])
@pytest.mark.parametrize("anywhere", [False, True])
@pytest.mark.parametrize("num_envs", [1, 5])
def test_specs_are_those_of_torchrl(num_envs: int, anywhere: bool, max_steps: int | None) -> None:
    check_env_specs(TrackEnv(limited(recorded(TRACKS, anywhere=anywhere), max_steps), num_envs))


@pytest.mark.parametrize("max_steps", [None, 4])
def test_one_pass_equals_torchrls_step_and_reset_bit_for_bit(max_steps: int | None) -> None:
    tracks = drawn(small_world().kernel, 40)
    cut = recorded(
        type(tracks)(tracks.cells, tracks.first, tracks.names % 2 == 0, tracks.names), t_max=2
    )
    cut = recorded(cut.tracks.select(cut.tracks.lengths > 1), t_max=2)
    ours, stock = (TrackEnv(limited(cut, max_steps), 50, seed=5) for _ in range(2))
    a, b = ours.reset(), stock.reset()
    policies = [RandomSubset(9, generator(0, "policy")) for _ in range(2)]
    ended = {"terminated": 0, "truncated": 0}
    for _ in range(100):
        frame_a, a = ours.step_and_maybe_reset(policies[0](a))
        frame_b, b = super(TrackEnv, stock)._step_and_maybe_reset(policies[1](b))
        assert (frame_a == frame_b).all()
        assert (a == b.select(*a.keys(True, True))).all()
        assert not (frame_a["next", "terminated"] & frame_a["next", "truncated"]).any()
        for flag in ended:
            ended[flag] += int(frame_a["next", flag].sum())
    assert min(ended.values()) > 100


def test_a_reset_of_some_rows_takes_tracks_for_these_alone() -> None:
    setting = recorded(by_hand(*[[cell, cell] for cell in range(9)], exits=False))
    env, rows = TrackEnv(setting, 4, seed=0), torch.tensor([True, False, False, True])
    before = env.reset()
    after = env.reset(before.clone().set("_reset", rows.unsqueeze(-1)))
    assert torch.equal(after["last_cell"][~rows], before["last_cell"][~rows])
    rest = env.reset(before.clone().set("_reset", torch.tensor([[True], [True], [True], [False]])))
    begun = [*before["last_cell"], *after["last_cell"][rows], *rest["last_cell"][:3]]
    assert sorted(map(int, begun)) == list(range(9))


def test_the_seed_and_the_stream_decide_the_order() -> None:
    tracks = recorded(drawn(small_world().kernel, 200))

    def order(**names: Any) -> list[int]:
        return [
            int(cell)
            for frame in rollout(Watched(tracks, 16, **names), 30)
            for cell in frame["target"]
        ]

    assert order(seed=0) == order(seed=0)
    assert order(seed=0) != order(seed=1)
    assert order(seed=0) != order(seed=0, stream="world-1")


def test_an_environment_goes_on_where_it_was_saved() -> None:
    tracks = recorded(drawn(small_world(exit_probability=0.4).kernel, 30))
    env = TrackEnv(tracks, 16, seed=0)
    rollout(env, 5)
    saved = env.snapshot()
    later = TrackEnv(tracks, 16, seed=0)
    later.restore(saved)
    for a, b in zip(rollout(env, 40), rollout(later, 40), strict=True):
        assert bool((a == b).all())
