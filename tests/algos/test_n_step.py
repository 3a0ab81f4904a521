"""n-step transitions against hand numbers, with episodes that terminate, are truncated, or meet the batch's end."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from trackmdp.algos.dqn import n_step

STATE = ("last_cell", "steps_since_detection", "action_history")


def batch(
    reward: list[list[float]], terminated: list[list[int]], truncated: list[list[int]]
) -> TensorDict:
    """Frames `[B, time]` whose state is numbered: `last_cell` is 10·row + t, and that of the next state one more."""
    rewards = torch.tensor(reward)
    rows, time = rewards.shape
    cell = 10 * torch.arange(rows)[:, None] + torch.arange(time)
    ends, cuts = (
        torch.tensor(flags, dtype=torch.bool).unsqueeze(-1) for flags in (terminated, truncated)
    )
    history = torch.zeros(rows, time, 2, 4, dtype=torch.bool)
    following = {
        "last_cell": cell + 1,
        "steps_since_detection": cell + 101,
        "action_history": history,
        "reward": rewards.unsqueeze(-1),
        "terminated": ends,
        "truncated": cuts,
        "done": ends | cuts,
    }
    now = {"last_cell": cell, "steps_since_detection": cell + 100, "action_history": history}
    action = torch.arange(rows * time * 4).reshape(rows, time, 4) % 3 == 0
    frames = {**now, "action": action, "next": TensorDict(following, [rows, time])}
    return TensorDict(frames, [rows, time])


FRAMES = batch(
    reward=[[1.0, 2.0, 4.0, 8.0], [1.0, 2.0, 4.0, 8.0], [1.0, 2.0, 4.0, 8.0]],
    terminated=[[0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]],
    truncated=[[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 1, 0]],
)
"""Rows: no end; terminated after the second step; truncated after the third."""


def test_one_step_is_the_frame_itself() -> None:
    rows = n_step(FRAMES.clone(), 1, 0.5)
    assert rows["next", "reward"].flatten().tolist() == [1, 2, 4, 8] * 3
    assert rows["discount"].tolist() == [0.5] * 12
    assert rows["next", "last_cell"].tolist() == [1, 2, 3, 4, 11, 12, 13, 14, 21, 22, 23, 24]
    assert rows["next", "terminated"].flatten().tolist() == [False] * 5 + [True] + [False] * 6


def test_three_steps_by_hand() -> None:
    rows = n_step(FRAMES.clone(), 3, 0.5)
    assert rows.batch_size == torch.Size([12])
    assert rows["next", "reward"].flatten().tolist() == [
        *(1 + 1 + 1, 2 + 2 + 2, 4 + 4, 8),
        *(1 + 1, 2, 4 + 4, 8),
        *(1 + 1 + 1, 2 + 2, 4, 8),
    ]
    assert rows["discount"].tolist() == [
        0.125,
        0.125,
        0.25,
        0.5,
        0.25,
        0.5,
        0.25,
        0.5,
        0.125,
        0.25,
        0.5,
        0.5,
    ]
    assert rows["next", "last_cell"].tolist() == [3, 4, 4, 4, 12, 12, 14, 14, 23, 23, 23, 24]
    assert (
        rows["next", "steps_since_detection"].tolist() == (rows["next", "last_cell"] + 100).tolist()
    )
    ends = rows["next", "terminated"].flatten().tolist()
    assert ends == [False] * 4 + [True, True] + [False] * 6
    assert rows["last_cell"].tolist() == [0, 1, 2, 3, 10, 11, 12, 13, 20, 21, 22, 23]
    assert torch.equal(rows["action"], FRAMES["action"].flatten(0, 1))


@given(
    rows=st.integers(1, 4),
    time=st.integers(1, 7),
    steps=st.integers(1, 9),
    gamma=st.sampled_from([0.0, 0.7, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_it_equals_a_loop(rows: int, time: int, steps: int, gamma: float, seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    reward = torch.randn(rows, time, generator=rng)
    ends, cuts = (torch.rand(2, rows, time, generator=rng) < 0.2).int()
    frames = batch(reward.tolist(), ends.tolist(), cuts.tolist())
    made = n_step(frames.clone(), steps, gamma).reshape(rows, time)
    for row in range(rows):
        for t in range(time):
            total, last = 0.0, t
            for k in range(steps):
                last = t + k
                total += gamma**k * float(reward[row, last])
                if ends[row, last] or cuts[row, last] or last == time - 1:
                    break
            assert made["next", "reward"][row, t].item() == pytest.approx(total, abs=1e-5)
            assert made["discount"][row, t].item() == pytest.approx(gamma ** (last - t + 1))
            assert made["next", "last_cell"][row, t] == 10 * row + last + 1
            assert bool(made["next", "terminated"][row, t]) == bool(ends[row, last])
