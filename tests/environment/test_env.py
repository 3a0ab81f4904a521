"""The environment: steps by hand, specs, seeds, flags."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from tests.acting import RandomSubset
from tests.helpers import Watched, advanced, hop_world, limited, small_world
from trackmdp.environment.env import TrackEnv
from trackmdp.seeding import generator
from trackmdp.world.model import World

STAY, LEAVE = 0.0, 0.75
"""Draws with which the target of `hop_world` hops on, and exits."""


def subset(*cells: int, m: int = 4) -> torch.Tensor:
    return torch.isin(torch.arange(m), torch.tensor(cells, dtype=torch.int64))


def state(
    cell: int, *history: torch.Tensor, target: int | None = None, t_max: int = 1
) -> dict[str, torch.Tensor]:
    """One row: located in `cell`, then missed with the subsets of `history`."""
    slots = torch.zeros(1, t_max + 1, 4, dtype=torch.bool)
    for n, action in enumerate(history):
        slots[0, n] = action
    return {
        "place": torch.tensor([cell if target is None else target]),
        "last_cell": torch.tensor([cell]),
        "steps_since_detection": torch.tensor([len(history)]),
        "action_history": slots,
    }


def step(
    world: World, before: dict[str, torch.Tensor], action: torch.Tensor, draw: float
) -> dict[str, Any]:
    after = advanced(world, before | {"action": action[None]}, [draw])
    return {key: value[0].squeeze().tolist() for key, value in after.items()}


def expected(
    cell: int, *history: torch.Tensor, target: int, reward: float, t_max: int = 1
) -> dict[str, Any]:
    rows = state(cell, *history, target=target, t_max=t_max)
    figures = {key: value[0].squeeze().tolist() for key, value in rows.items()}
    return figures | {
        "reward": pytest.approx(reward),
        "terminated": False,
        "truncated": False,
        "done": False,
    }


EXITED = {
    "place": 4,
    "reward": 0.0,
    "steps_since_detection": 0,
    "terminated": True,
    "truncated": False,
    "done": True,
}
WORLD = hop_world(t_max=1)
"""r = 2, c = 0.1, 0.2, 0.3, 0.4, D = 0.9."""


def test_a_detection() -> None:
    after = step(WORLD, state(0), subset(1, 3), STAY)
    assert after == expected(1, target=1, reward=2.0 - 0.6)


def test_a_miss_and_a_second_one() -> None:
    first = step(WORLD, state(0), subset(0, 2), STAY)
    assert first == expected(0, subset(0, 2), target=1, reward=-0.4)
    second = step(WORLD, state(0, subset(0, 2), target=1), subset(0), STAY)
    assert second == expected(0, subset(0, 2), subset(0), target=2, reward=-0.1)


def test_a_detection_after_a_miss_clears_the_history() -> None:
    after = step(WORLD, state(0, subset(0, 2), target=1), subset(2), STAY)
    assert after == expected(2, target=2, reward=2.0 - 0.3)


@pytest.mark.parametrize("action", [subset(), subset(3), subset(0, 1, 2, 3)])
def test_the_safe_action_replaces_whatever_was_chosen(action: torch.Tensor) -> None:
    after = step(WORLD, state(0, subset(0), subset(0), target=2), action, STAY)
    assert after == expected(3, target=3, reward=2.0 - 0.9)


@pytest.mark.parametrize("action", [subset(), subset(0, 1, 2, 3)])
@pytest.mark.parametrize("history", [(), (subset(0),), (subset(0), subset(0))])
def test_the_exit_step_costs_and_earns_nothing(
    action: torch.Tensor, history: tuple[torch.Tensor, ...]
) -> None:
    after = step(WORLD, state(2, *history), action, LEAVE)
    assert {key: after[key] for key in EXITED} == EXITED
    assert after["last_cell"] == 2
    assert not torch.tensor(after["action_history"]).any()


def test_t_max_zero_forces_after_one_miss() -> None:
    world = hop_world(t_max=0)
    missed = step(world, state(0, t_max=0), subset(3), STAY)
    assert missed == expected(0, subset(3), target=1, reward=-0.4, t_max=0)
    forced = step(world, state(0, subset(3), target=1, t_max=0), subset(), STAY)
    assert forced == expected(2, target=2, reward=1.1, t_max=0)


def test_the_time_limit_truncates_and_the_exit_terminates() -> None:
    world = limited(hop_world(), 3)
    for count, draw, flags in [
        (1, STAY, (False, False, False)),
        (2, STAY, (False, True, True)),
        (2, LEAVE, (True, False, True)),
        (0, LEAVE, (True, False, True)),
    ]:
        after = step(world, state(0) | {"step_count": torch.tensor([count])}, subset(1), draw)
        assert (after["terminated"], after["truncated"], after["done"]) == flags
        assert after["step_count"] == count + 1
        assert after["reward"] == pytest.approx(0.0 if draw == LEAVE else 1.8)


def test_the_target_is_located_after_it_has_moved() -> None:
    """Sensing the cell it stands in finds nothing once it hops on."""
    assert step(WORLD, state(0), subset(0), STAY)["steps_since_detection"] == 1


@pytest.mark.parametrize("max_steps", [None, 1, 7])
@pytest.mark.parametrize("num_envs", [1, 3, 64])
def test_specs_are_those_of_torchrl(num_envs: int, max_steps: int | None) -> None:
    check_env_specs(TrackEnv(limited(small_world(), max_steps), num_envs))


def rollout(env: TrackEnv, steps: int, seed: int = 0) -> list[TensorDictBase]:
    """Frames under random subsets, auto-reset on the way."""
    policy, rows = RandomSubset(env.num_cells, generator(seed, "policy")), env.reset()
    frames = []
    for _ in range(steps):
        frame, rows = env.step_and_maybe_reset(policy(rows))
        frames.append(frame)
    return frames


@pytest.mark.parametrize(("t_max", "max_steps"), [(0, None), (1, 5), (3, None), (2, 1)])
def test_every_frame_of_a_long_run_lies_in_the_specs(t_max: int, max_steps: int | None) -> None:
    world = small_world(t_max=t_max)
    env = Watched(limited(world, max_steps), 7, seed=3)
    reset = env.reset()
    assert env.observation_spec.is_in(reset.select(*env.observation_spec.keys()))
    seen, lengths = set(), torch.zeros(7, dtype=torch.int64)
    for frame in rollout(env, 300):
        after = frame["next"]
        assert env.observation_spec.is_in(frame.select(*env.observation_spec.keys()))
        assert env.observation_spec.is_in(after.select(*env.observation_spec.keys()))
        assert env.action_spec.is_in(frame["action"])
        assert env.reward_spec.is_in(after["reward"])
        assert after["reward"].shape == (7, 1)
        assert after["reward"].dtype == torch.float32
        assert env.full_done_spec.is_in(after.select("done", "terminated", "truncated"))
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
        assert not (after["terminated"] & after["truncated"]).any()
        assert torch.equal(after["terminated"].squeeze(-1), after["target"] == 9)
        assert (frame["target"] < 9).all()
        empty = torch.arange(t_max + 1) >= frame["steps_since_detection"].unsqueeze(-1)
        assert not frame["action_history"][empty].any()
        located = after["steps_since_detection"] == 0
        assert torch.equal(
            (after["last_cell"] == after["target"])[located], after["target"][located] < 9
        )
        lengths = (lengths + 1) * ~frame["done"].squeeze(-1)
        if max_steps:
            assert torch.equal(
                after["truncated"].squeeze(-1), (lengths == max_steps) & (after["target"] < 9)
            )
            lengths = lengths * ~after["done"].squeeze(-1)
        seen |= set(frame["steps_since_detection"].tolist())
    assert seen == set(
        range(t_max + 2 if max_steps is None or max_steps > t_max + 1 else max_steps)
    )


@pytest.mark.parametrize("max_steps", [None, 4])
def test_one_pass_equals_torchrls_step_and_reset_bit_for_bit(max_steps: int | None) -> None:
    ours, stock = (TrackEnv(limited(small_world(t_max=2), max_steps), 50, seed=5) for _ in range(2))
    a, b = ours.reset(), stock.reset()
    policies = [RandomSubset(9, generator(0, "policy")) for _ in range(2)]
    ended = {"terminated": 0, "truncated": 0}
    for _ in range(400):
        frame_a, a = ours.step_and_maybe_reset(policies[0](a))
        frame_b, b = super(TrackEnv, stock)._step_and_maybe_reset(policies[1](b))
        assert set(frame_a.keys(True, True)) == set(frame_b.keys(True, True))
        assert (frame_a == frame_b).all()
        carried = set(a.keys(True, True))
        assert set(b.keys(True, True)) - carried == {"action"}  # the policy writes it anew
        assert carried <= set(b.keys(True, True))
        assert (a == b.select(*carried)).all()
        assert all(a[key].dtype == b[key].dtype and a[key].shape == b[key].shape for key in carried)
        for flag in ended:
            ended[flag] += int(frame_a["next", flag].sum())
    assert ended["terminated"] > 500
    assert (ended["truncated"] > 500) == (max_steps is not None)


def frames_equal(first: TrackEnv, second: TrackEnv, steps: int = 40) -> bool:
    return all(
        bool((a == b).all())
        for a, b in zip(rollout(first, steps), rollout(second, steps), strict=True)
    )


def test_the_seed_and_the_stream_decide_everything() -> None:
    world = small_world()
    assert frames_equal(TrackEnv(world, 16, seed=0), TrackEnv(world, 16, seed=0))
    assert not frames_equal(TrackEnv(world, 16, seed=0), TrackEnv(world, 16, seed=1))
    assert not frames_equal(
        TrackEnv(world, 16, seed=0), TrackEnv(world, 16, seed=0, stream="world-1")
    )
    again = TrackEnv(world, 16, seed=4)
    rollout(again, 3)
    again.set_seed(0)
    assert frames_equal(TrackEnv(world, 16, seed=0), again)


def test_the_global_generator_is_neither_read_nor_moved() -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = rollout(TrackEnv(small_world(), 8, seed=2), 20)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    assert all(
        bool((a == b).all())
        for a, b in zip(first, rollout(TrackEnv(small_world(), 8, seed=2), 20), strict=True)
    )


def test_generators_go_on_where_they_were_saved() -> None:
    env = TrackEnv(small_world(exit_probability=0.4), 16, seed=0)
    rollout(env, 5)
    saved = env.snapshot()
    later = TrackEnv(small_world(exit_probability=0.4), 16, seed=99)
    later.restore(saved)
    assert frames_equal(env, later)


def test_starts_are_uniform_over_the_cells() -> None:
    env = TrackEnv(small_world(), 90_000, seed=0)
    starts = env.reset()
    counts = torch.bincount(starts["last_cell"], minlength=9)
    assert ((counts - 10_000) ** 2 / 10_000).sum() < 26.1  # chi-square, 8 degrees, 0.1 %
    assert torch.equal(starts["last_cell"], env.target)
    assert not starts["steps_since_detection"].any()
    assert not starts["action_history"].any()
