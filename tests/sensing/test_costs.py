"""The pseudo-reward against hand numbers: r = 2, c = 0.1, 0.2, 0.3, 0.4, D = 0.9."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from trackmdp.errors import UserError
from trackmdp.sensing.outcomes import Costs, Outcomes
from trackmdp.sensing.task import Task
from trackmdp.world.make import make_world

ACTION = torch.tensor([[True, False, True, False]])


def task(cost: list[float]) -> Task:
    return Task(2, cost=np.array(cost), safe_cost=0.9, t_max=1, reward=2.0)


@pytest.mark.parametrize(
    ("sensed", "forced", "in_grid", "reward"),
    [
        (True, False, True, 2.0 - 0.4),
        (False, False, True, -0.4),
        (False, True, True, 2.0 - 0.9),
        (True, True, True, 2.0 - 0.9),
        (False, False, False, 0.0),
        (False, True, False, 0.0),
    ],
)
def test_one_step(sensed: bool, forced: bool, in_grid: bool, reward: float) -> None:
    flags = [torch.tensor([flag]) for flag in (sensed, forced, in_grid)]
    mine = task([0.1, 0.2, 0.3, 0.4])
    spent = Costs(mine).sensing_cost(ACTION, torch.tensor([0]))
    earned = Outcomes(mine).reward(spent, *flags)
    assert earned.shape == (1,)
    assert earned.item() == pytest.approx(reward)


def test_sensing_cost_per_cell_and_for_all_cells() -> None:
    actions = torch.tensor(
        [[0, 0, 0, 0], [1, 0, 1, 0], [0, 1, 0, 1], [1, 1, 1, 1]], dtype=torch.bool
    )
    per_cell = Costs(task([0.1, 0.2, 0.3, 0.4])).sensing_cost(
        actions, torch.zeros(4, dtype=torch.int64)
    )
    np.testing.assert_allclose(per_cell, [0, 0.4, 0.6, 1.0], rtol=1e-6)
    same = Costs(task([0.3] * 4)).sensing_cost(actions, torch.zeros(4, dtype=torch.int64))
    np.testing.assert_allclose(same, [0, 0.6, 0.6, 1.2], rtol=1e-6)
    assert per_cell.dtype == same.dtype == torch.float32


def test_more_than_255_sensors_are_counted() -> None:
    many = Task(40, cost=np.full(1600, 0.5), safe_cost=0.9, t_max=1)
    assert (
        Costs(many).sensing_cost(torch.ones(1, 1600, dtype=torch.bool), torch.tensor([0])).item()
        == 800.0
    )


@pytest.mark.parametrize("cost", [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.2] * 6])
def test_a_window_costs_what_its_sensors_in_the_grid_cost(cost: list[float]) -> None:
    """2 x 3 cells, radius 1, all nine sensors on: from cell 0 cells 0, 1, 3, 4 are there, from cell 4 all six."""
    near = Task((2, 3), cost=cost, t_max=0, window=1)
    spent = Costs(near).sensing_cost(torch.ones(2, 9, dtype=torch.bool), torch.tensor([0, 4]))
    np.testing.assert_allclose(
        spent, [sum(cost[cell] for cell in (0, 1, 3, 4)), sum(cost)], rtol=1e-6
    )


def test_complex_prices_are_refused_by_name() -> None:
    with pytest.raises(UserError, match=r"^cost\.sensor.*complex"):
        make_world("random_walk", size=3, cost=np.full(9, 0.1j))


def test_a_grid_without_a_sensor_is_refused() -> None:
    with pytest.raises(UserError, match=r"^cost: nan"):
        Task(2, cost=np.full(4, np.nan), t_max=1)


@pytest.mark.parametrize("shape", [(3, 3), (9,)])
def test_an_array_of_prices_is_nan_where_there_is_no_sensor(shape: tuple[int, ...]) -> None:
    prices = np.full(9, 0.5)
    prices[[0, 7]] = np.nan
    world = make_world("random_walk", size=3, cost=prices.reshape(shape))
    assert np.flatnonzero(np.isnan(world.cost)).tolist() == [0, 7]
    assert world.safe_cost == pytest.approx(3.5)


@pytest.mark.parametrize("name", ["a.csv", "a.npy"])
def test_a_file_of_prices_is_nan_where_there_is_no_sensor(name: str, tmp_path: Path) -> None:
    prices = np.full((3, 3), 0.5)
    prices[0, 0] = prices[2, 1] = np.nan
    if name.endswith("npy"):
        np.save(tmp_path / name, prices)
    else:
        np.savetxt(tmp_path / name, prices, delimiter=",")
    world = make_world("random_walk", size=3, cost=str(tmp_path / name))
    assert np.flatnonzero(np.isnan(world.cost)).tolist() == [0, 7]
    assert world.available.tolist() == [not np.isnan(each) for each in prices.flat]


@pytest.mark.parametrize("name", ["cost", "detection"])
def test_an_array_of_another_grid_is_refused_by_its_rows_and_columns(name: str) -> None:
    with pytest.raises(UserError, match=f"^{name}: 3 x 2 numbers, expected 2 x 3"):
        make_world("random_walk", size=(2, 3), **{name: np.full((3, 2), 0.5)})


@pytest.mark.parametrize(("word", "grid"), [("cost", (3, 4)), ("detection", (3, 4)), ("cost", 6)])
def test_a_file_of_another_grid_is_refused_by_its_rows_and_columns(
    word: str, grid: Any, tmp_path: Path
) -> None:
    """Transposed, its numbers would be those of other cells."""
    np.save(tmp_path / "a.npy", np.full((4, 3), 0.5))
    with pytest.raises(UserError, match=r"a.npy: 4 x 3 numbers, expected one number or .* x"):
        make_world("random_walk", size=grid, **{word: str(tmp_path / "a.npy")})
    np.save(tmp_path / "row.npy", np.full((1, 12), 0.5))
    assert make_world("random_walk", size=(3, 4), cost=str(tmp_path / "row.npy")).cost[11] == 0.5
