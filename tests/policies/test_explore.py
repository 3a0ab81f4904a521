"""Modules that act while frames are collected."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from trackmdp.arrays.types import BoolArray
from trackmdp.policies.acting import Exploring, RenewedTable
from trackmdp.policies.policy import Policy
from trackmdp.sensing.task import Task


def test_a_chain_is_looked_up_by_cell_and_misses() -> None:
    chains = np.zeros((4, 2, 4), dtype=bool)
    chains[1, 0, 2] = chains[1, 1, 3] = chains[2, 1, 0] = True
    rows = {
        "last_cell": torch.tensor([1, 1, 2, 0, 1]),
        "steps_since_detection": torch.tensor([0, 1, 1, 1, 2]),
    }
    action = Policy.from_dense(Task(2, cost=0.1, t_max=1), chains)(TensorDict(rows, [5]))["action"]
    on = [cells.nonzero().flatten().tolist() for cells in action]
    assert on == [[2], [3], [0], [], [3]]
    assert action.dtype == torch.bool


@pytest.mark.parametrize("explore", [0.0, 0.25, 1.0])
def test_everything_is_sensed_now_and_then_and_only_where_the_target_is_located(
    explore: float,
) -> None:
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
    assert everything.float().mean().item() == pytest.approx(
        explore, abs=5 * (explore * (1 - explore) / 4000) ** 0.5
    )


@pytest.mark.parametrize("window", [None, 1])
def test_a_renewed_table_acts_as_its_policy(
    window: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "trackmdp.policies.acting._ROWS_AT_ONCE", 7
    )  # blocks begin between the rows of a cell
    task = Task((4, 5), cost=0.1, t_max=1, window=window)
    near = np.ones((20, 2, 20), dtype=bool) if window is None else all_in_reach(task)
    policy = Policy.from_dense(task, near & (np.random.default_rng(0).random((20, 2, 20)) < 0.5))
    table = RenewedTable(task)
    assert table.bits.shape == (
        40,
        3 if window is None else 2,
    )  # 20 or 9 sensors, eight to the byte
    table.renew(policy)
    cell, n = torch.cartesian_prod(torch.arange(20), torch.arange(2)).unbind(-1)
    history = torch.zeros(40, 2, task.num_sensors, dtype=torch.bool)
    rows = TensorDict(
        {"last_cell": cell, "steps_since_detection": n, "action_history": history}, [40]
    )
    acted = table(rows.clone())["action"]
    assert torch.equal(acted, policy(rows.clone())["action"])
    assert acted.sum() == policy.sets.nnz


def all_in_reach(task: Task) -> BoolArray:
    """`[M, t_max+1, M]`, every sensor of the window of each cell."""
    assert task.window is not None
    row, column = np.divmod(np.arange(task.num_cells), task.columns)
    far = np.maximum(abs(row[:, None] - row), abs(column[:, None] - column))
    return np.repeat((far <= task.window)[:, None], task.num_choices, axis=1)
