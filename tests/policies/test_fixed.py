"""Modules that act while frames are collected."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from trackmdp.policies.explore import Exploring
from trackmdp.policies.fixed import ChainPolicy, RandomSubset
from trackmdp.policies.policy import Policy
from trackmdp.world.model import Task


def test_a_chain_is_looked_up_by_cell_and_misses() -> None:
    chains = np.zeros((4, 2, 4), dtype=bool)
    chains[1, 0, 2] = chains[1, 1, 3] = chains[2, 1, 0] = True
    rows = {"last_cell": torch.tensor([1, 1, 2, 0, 1]), "steps_since_detection": torch.tensor([0, 1, 1, 1, 2])}
    action = ChainPolicy(chains)(TensorDict(rows, [5]))["action"]
    on = [cells.nonzero().flatten().tolist() for cells in action]
    assert on == [[2], [3], [0], [], [3]]
    assert action.dtype == torch.bool


@pytest.mark.parametrize("explore", [0.0, 0.25, 1.0])
def test_everything_is_sensed_now_and_then_and_only_where_the_target_is_located(explore: float) -> None:
    task = Task(2, cost=0.1, t_max=1)
    chains = np.zeros((4, 2, 4), dtype=bool)
    chains[1, 0, 2] = chains[1, 1, 3] = True
    policy = Exploring(task)
    policy.renew(Policy.from_dense(task, chains))
    policy.explore.fill_(explore)
    torch.manual_seed(0)
    rows = {"last_cell": torch.full((8000,), 1), "steps_since_detection": torch.arange(8000) % 2}
    action = policy(TensorDict(rows, [8000]))["action"]
    assert (action[1::2] == torch.tensor([False, False, False, True])).all()
    everything = action[::2].all(-1)
    assert (action[::2][~everything] == torch.tensor([False, False, True, False])).all()
    assert everything.float().mean().item() == pytest.approx(explore, abs=5 * (explore * (1 - explore) / 4000) ** 0.5)


def test_random_subsets_are_fair_coins_of_their_own_generator() -> None:
    """130 sensors span three words; every sensor on half the time, every pair of neighbours independent."""
    rows = TensorDict({"last_cell": torch.zeros(20_000, dtype=torch.int64)}, [20_000])
    before = torch.get_rng_state()
    action = RandomSubset(130, torch.Generator().manual_seed(0))(rows)["action"].clone()
    assert torch.equal(RandomSubset(130, torch.Generator().manual_seed(0))(rows)["action"], action)
    assert torch.equal(torch.get_rng_state(), before)
    assert action.shape == (20_000, 130)
    tolerance = 5 * 0.5 / 20_000**0.5
    assert (action.double().mean(0) - 0.5).abs().max() < tolerance
    assert ((action[:, 1:] == action[:, :-1]).double().mean(0) - 0.5).abs().max() < tolerance
