from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.algos.hindsight import chain_returns
from trackmdp.algos.gains import Credit, clocked_advantage


def test_the_gain_of_a_sensor_by_hand() -> None:
    credit = Credit(0.5, 5.0, -4.0, torch.ones(2))
    assert credit.gain(torch.tensor([4.0, 2.0])).tolist() == [3.0, 2.0]


def test_clocked_advantage_compares_each_clock_with_a_detection() -> None:
    clocked = torch.tensor([[5.0, 4.0, 1.0], [2.0, 2.0, -3.0]])
    assert clocked_advantage(clocked).tolist() == [[1.0, 0.0], [4.0, 5.0]]


def test_chain_returns_by_hand() -> None:
    """T_max = 1, r = 1, D = 5, γ = 1/2; paths: hit at once, hit at n = 1, forced, gone at once, gone at n = 1."""
    hits = torch.tensor([[True, False, False, False, False], [False, True, False, False, False]])
    inside = torch.tensor(
        [
            [True, True, True, False, True],
            [True, True, True, False, False],
            [True, True, True, False, False],
        ]
    )
    cost = torch.tensor([[0.25] * 5, [0.5] * 5])
    value = torch.tensor([[2.0] * 5, [4.0] * 5, [6.0] * 5])
    returns = chain_returns(hits, inside, cost, value, safe_cost=5.0, discount=0.5)
    forced = 1 - 5 + 0.5 * 6
    assert returns[2].tolist() == [forced, forced, forced, 0.0, 0.0]
    assert returns[1].tolist() == [0.5 * forced - 0.5, 3.0 - 0.5, 0.5 * forced - 0.5, 0.0, 0.0]
    assert returns[0].tolist() == [
        2.0 - 0.25,
        0.5 * 2.5 - 0.25,
        0.5 * (0.5 * forced - 0.5) - 0.25,
        0.0,
        -0.25,
    ]


def walked(
    n: int, hits: Tensor, inside: Tensor, cost: Tensor, value: Tensor, discount: float
) -> float:
    """The return from step n on of one path, forwards: what an episode pays, until the target is located or gone."""
    total, weight = 0.0, 1.0
    for step in range(n, len(inside)):
        if not inside[step]:
            return total
        if step == len(hits):
            return total + weight * (1.0 - 7.0 + discount * float(value[step]))
        total -= weight * float(cost[step])
        if hits[step]:
            return total + weight * (1.0 + discount * float(value[step]))
        weight *= discount
    raise AssertionError


@given(st.integers(0, 4), st.integers(1, 6), st.floats(0.0, 1.0), st.integers(0, 2**31))
def test_chain_returns_pay_what_the_episode_pays(
    t_max: int, paths: int, discount: float, seed: int
) -> None:
    rng = torch.Generator().manual_seed(seed)
    inside = (torch.rand(t_max + 2, paths, generator=rng) < 0.8).cummin(0).values
    hits = torch.rand(t_max + 1, paths, generator=rng) < 0.4
    cost = torch.rand(t_max + 1, paths, generator=rng)
    value = torch.randn(t_max + 2, paths, generator=rng)
    returns = chain_returns(hits, inside, cost, value, safe_cost=7.0, discount=discount)
    for path in range(paths):
        expected = [
            walked(n, hits[:, path], inside[:, path], cost[:, path], value[:, path], discount)
            for n in range(t_max + 2)
        ]
        assert returns[:, path].tolist() == pytest.approx(expected, abs=1e-4)
