"""Additive Q: the best of 2^M subsets is a comparison per sensor."""

from __future__ import annotations

import itertools

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.helpers import random_state, small_world
from trackmdp.policies.qvalue import EpsilonFlip, joint_value, make_qvalue

SUBSETS = torch.tensor(list(itertools.product([False, True], repeat=4)))


def values(t_max: int = 1) -> TensorDict:
    """Networks of random sensor values on 200 states of a 2x2 world."""
    torch.manual_seed(0)
    module = make_qvalue(small_world(2, t_max).task, 16, scale=0.1)
    with torch.no_grad():
        module.module.sensor.weight.normal_(std=2.0)
        return module(random_state(small_world(2, t_max), 200, seed=0))


def value(rows: TensorDict, action: Tensor) -> Tensor:
    """`[B]` Q of an action `[B, 4]`."""
    return joint_value(rows["base"], rows["sensor_value"], action)


def joint(rows: TensorDict) -> Tensor:
    """`[B, 16]` Q of every subset."""
    return torch.stack([value(rows, subset.expand(len(rows), 4)) for subset in SUBSETS], dim=1)


def test_the_best_subset_is_found_per_sensor() -> None:
    rows = values()
    greedy = EpsilonFlip(0.0)(rows)["action"]
    best = joint(rows).max(dim=1).values
    torch.testing.assert_close(value(rows, greedy), best)
    torch.testing.assert_close(rows["base"].squeeze(-1), best)
    assert len(greedy.unique(dim=0)) > 4


def test_the_sensors_add_up() -> None:
    """Q of a subset is Q of none plus the values of its sensors."""
    rows = values()
    none = value(rows, SUBSETS[0].expand(200, 4))
    torch.testing.assert_close(
        joint(rows), none[:, None] + rows["sensor_value"] @ SUBSETS.T.float()
    )


def test_no_sensor_counts_where_the_safe_action_is_forced() -> None:
    rows = values(t_max=1)
    forced = rows["steps_since_detection"] == 2
    assert forced.sum() > 20
    assert not rows["sensor_value"][forced].any()
    assert (rows["sensor_value"][~forced] != 0).all()
    torch.testing.assert_close(joint(rows)[forced], rows["base"][forced].expand(-1, 16))


def test_values_count_in_prices() -> None:
    """The same network for rewards ten times as large: sensor values ten times as large."""
    world, rows = small_world(2), random_state(small_world(2), 50, seed=0)
    small, large = (make_qvalue(world.task, 16, scale=scale) for scale in (0.1, 1.0))
    large.load_state_dict({**small.state_dict(), "module.unit": large.module.unit})
    ratio = large(rows.clone())["sensor_value"] / small(rows.clone())["sensor_value"]
    free = rows["steps_since_detection"] <= 1
    torch.testing.assert_close(ratio[free], torch.full_like(ratio[free], 10.0))


def test_a_flip_is_the_rarer_the_more_it_costs_and_only_while_exploring() -> None:
    worth = torch.tensor([-4.0, -1.0, -0.5, 0.0, 0.5, 1.0, 4.0]).expand(100_000, 7)
    unit = torch.tensor([2.0, 2.0, 2.0, 2.0, 2.0, 1.0, 0.5])
    rows = TensorDict({"sensor_value": worth, "last_cell": torch.zeros(100_000)}, [100_000])
    flip = EpsilonFlip(0.2, lambda cell: unit.expand(len(cell), 7))
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM):
        acted = flip(rows.clone())["action"]
    often = (acted != (worth > 0)).float().mean(0)
    assert often.tolist() == pytest.approx([0.1, 0.2, 0.2, 0, 0.2, 0.2, 0.025], abs=0.006)
    before = torch.get_rng_state()
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.MODE):
        with set_exploration_type(kind):
            assert torch.equal(flip(rows.clone())["action"], worth > 0)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("epsilon", [0.0, 1.0])
def test_the_ends_of_epsilon(epsilon: float) -> None:
    sensor = torch.randn(100, 9, generator=torch.Generator().manual_seed(1))
    with set_exploration_type(ExplorationType.RANDOM):
        acted = EpsilonFlip(epsilon)(TensorDict({"sensor_value": sensor}, [100]))["action"]
    assert torch.equal(acted, (sensor > 0) if epsilon == 0.0 else (sensor <= 0))
