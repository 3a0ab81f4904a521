"""Networks over several targets: sums over those in the grid of what a single target's part makes of each."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

import trackmdp as tm
from trackmdp.environment.env import TrackEnv
from trackmdp.policies.actor_critic import make_actor, make_critic
from trackmdp.policies.encoder import OverTargets, StateEncoder
from trackmdp.policies.qvalue import make_qvalue

GROUP = tm.make_world("random_walk", size=3, targets=3, exit_probability=0.1, t_max=1)


KEYS = ("last_cell", "steps_since_detection", "action_history", "present")


def states(count: int = 40) -> tuple[Tensor, ...]:
    env = TrackEnv(GROUP, count, seed=2)
    shown = env.rollout(4, break_when_any_done=False)[:, -1]
    return tuple(shown[key] for key in KEYS)


def together(*parts: Tensor) -> TensorDict:
    return TensorDict(dict(zip(KEYS, parts, strict=True)), len(parts[0]))


def test_the_targets_in_the_grid_are_added_each_with_the_actions_since_its_detection() -> None:
    torch.manual_seed(0)
    parts = [StateEncoder(GROUP.task, 8) for _ in range(2)]
    cell, n, history, present = states()
    assert not present.all()
    assert (n > 0).any()
    found = OverTargets(parts, (0, 1, 1))(cell, n, history, present)
    expected = torch.zeros(40, 8)
    for row in range(40):
        for target, part in enumerate((parts[0], parts[1], parts[1])):
            if present[row, target]:
                own = history[row].clone()
                own[int(n[row, target]) :] = False
                expected[row] += part(cell[row, target], n[row, target], own)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("kinds", [(0, 0, 0), (0, 1, 1)])
def test_targets_of_one_kind_may_change_places(kinds: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    cell, n, history, present = states()
    other = [0, 2, 1] if 1 in kinds else [2, 0, 1]
    for net in (
        make_actor(GROUP.task, 8, 0.0, kinds),
        make_critic(GROUP.task, 8, kinds),
        make_qvalue(GROUP.task, 8, 1.0, kinds),
    ):
        for part in net.parameters():
            torch.nn.init.normal_(part)
        key = net.out_keys[0]
        rows = together(cell, n, history, present)
        moved = together(cell[:, other], n[:, other], history, present[:, other])
        torch.testing.assert_close(net(rows)[key], net(moved)[key])
        swapped = together(cell[:, [1, 0, 2]], n, history, present)
        assert not torch.allclose(net(rows)[key], net(swapped)[key])


def test_no_sensor_is_worth_anything_where_the_safe_action_is_forced() -> None:
    net = make_qvalue(GROUP.task, 8, 1.0, (0, 0, 0))
    cell, n, history, present = states()
    n[0, 1] = GROUP.task.t_max + 1
    value = net(together(cell, n, history, present))["sensor_value"]
    assert not value[0].any()
    assert value[n.amax(-1) <= GROUP.task.t_max].all()
