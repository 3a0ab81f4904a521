"""`TrackEnv` among TorchRL's own parts: what it shows and hides."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.helpers import limited, small_world
from tests.tracks import by_hand, recorded
from trackmdp.errors import UserError
from trackmdp.world.env import TrackEnv

OBSERVED = {"last_cell", "steps_since_detection", "action_history"}


@pytest.mark.parametrize("max_steps", [None, 5])
@pytest.mark.parametrize("tracks", [False, True])
def test_the_true_cell_is_in_no_spec_and_no_tensordict(max_steps: int | None, tracks: bool) -> None:
    problem = recorded(by_hand([0, 1, 2], [3, 4])) if tracks else small_world()
    env = TrackEnv(limited(problem, max_steps), 4)
    observed = OBSERVED | ({"step_count"} if max_steps else set())
    assert set(env.observation_spec.keys(True, True)) == observed
    assert not set(env.state_spec.keys(True, True))
    flags = {"done", "terminated", "truncated"}
    shown = {*observed, "action", *flags, *(("next", key) for key in {*observed, "reward", *flags})}
    assert set(env.rollout(3, break_when_any_done=False).keys(True, True)) == shown


def test_what_is_observed_after_a_miss_is_the_same_wherever_the_target_is() -> None:
    """Nine rows, the target of each in a cell of its own; no sensor is on, and none of them exits."""
    world = replace(small_world(), t_max=3, max_steps=9)
    env = TrackEnv(world, 9)
    env.reset()
    there = env.snapshot()
    there["rows"] |= {"target": torch.arange(9), "last_cell": torch.full((9,), 4)}
    rows = env.restore(there)
    for _ in range(3):
        frame = env.step(rows.set("action", torch.zeros(9, 9, dtype=torch.bool)))["next"]
        inside = frame[~frame["terminated"].squeeze(-1)]
        assert len(env.target.unique()) > 2
        assert (inside == inside[:1].expand(len(inside))).all()
        rows = frame.select(*env.observation_spec)


def test_a_step_before_the_first_reset_is_one_line() -> None:
    env = TrackEnv(small_world(), 2)
    with pytest.raises(UserError, match=r"before the first reset, expected env\.reset\(\)"):
        env.step(env.fake_tensordict())
