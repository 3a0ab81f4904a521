"""Learning where sensors miss: what was reported stands for what was not, and policies come near the optimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.algos.hindsight import SOLVES, batches, learn, policy
from tests.helpers import algorithm, small_world
from trackmdp.algos.gains import chain_returns
from trackmdp.algos.learned_kernel import observed_paths
from trackmdp.algos.moves import MoveBuffer
from trackmdp.algos.paths import report_weights
from trackmdp.algos.segments import SegmentBuffer
from trackmdp.errors import UserError
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.solvers.kernel_estimate import KernelEstimate
from trackmdp.world.model import Task

TASK = Task((1, 3), cost=0.1, t_max=0, detection=[1.0, 0.5, 0.25])


def test_weights_are_the_inverse_of_the_probability_of_being_known() -> None:
    weights = report_weights(TASK, torch.device("cpu"))
    assert weights is not None
    assert weights.tolist() == [1.0, 2.0, 4.0, 1.0]
    assert report_weights(small_world(), torch.device("cpu")) is None


def test_moves_are_drawn_in_proportion_to_their_weights() -> None:
    """Out of cell 0: 4 times to 0, 2 to 1 (each counts 2), 1 to 2 (counts 4), 4 exits: all four alike."""
    rng, weights = torch.Generator().manual_seed(0), report_weights(TASK, torch.device("cpu"))
    buffer = MoveBuffer(3, 100, rng, weights)
    start, end = [0] * 11 + [2], [0] * 4 + [1] * 2 + [2] + [3] * 4 + [2]
    buffer.load_state_dict({"moves": torch.tensor([start, end])})
    first, second = buffer.paths(12_000, 1)
    assert torch.bincount(second[first == 0], minlength=4).tolist() == pytest.approx([1000] * 4, abs=1)
    assert second[first == 1].unique().tolist() == [3]  # no move was seen out of 1: its paths leave
    assert second[first == 2].unique().tolist() == [2]


def test_segments_count_by_all_their_reports() -> None:
    """From 0: 0 1 1 (2 · 2), 0 2 1 (4 · 2), 0 1 M (2): 4 to 8 to 2 of 14."""
    rng, weights = torch.Generator().manual_seed(0), report_weights(TASK, torch.device("cpu"))
    buffer = SegmentBuffer(3, 2, 100, rng, weights)
    cells = torch.tensor([[0, 1, 1], [0, 2, 1], [0, 1, 3]])
    steps = torch.stack([cells[:, :-1], cells[:, 1:], 1 * (cells[:, 1:] == 3)])
    buffer.load_state_dict({"judge": None, "paths": {"steps": steps}})
    paths = buffer.paths(42_000, 2)
    mine = paths[:, paths[0] == 0]
    count = [int((torch.tensor(path) == mine[1:].T).all(1).sum()) for path in ([1, 1], [2, 1], [1, 3])]
    assert count == pytest.approx([4000, 8000, 2000], abs=2)


def test_returns_take_the_mean_over_the_reports() -> None:
    """At .25 the sensor reports: .25 (1 + .5 · 4) + .75 · .5 · (1 + .5 · 2 - 5), less its price of .1."""
    found = chain_returns(
        torch.tensor([[0.25]]),
        torch.ones(2, 1, dtype=torch.bool),
        torch.tensor([[0.1]]),
        torch.tensor([[4.0], [2.0]]),
        reward=1.0,
        safe_cost=5.0,
        discount=0.5,
    )
    assert found.flatten().tolist() == pytest.approx([0.75 - 1.125 - 0.1, -3.0])


@pytest.mark.slow
@pytest.mark.parametrize("markov", [True, False])
def test_hindsight_comes_near_the_optimum(markov: bool) -> None:
    world = replace(small_world(exit_probability=0.02), detection=np.linspace(0.7, 0.95, 9), markov=markov)
    learner = learn(world, batches(world, 64), *SOLVES, "algo.total_frames=16384", "algo.buffer_size=20000")
    best = optimal.solve(world)
    assert best.certified
    assert regret_per_step(best.upper, evaluate(world, policy(learner, world))) < 0.02


def test_misses_are_censored_moves() -> None:
    """With p_d = .4 for moves to the right half and 1 elsewhere, the moves seen at once are a biased sample."""
    world = replace(small_world(exit_probability=0.1), detection=np.where(np.arange(9) % 3 == 2, 0.4, 1.0))
    paths = [observed_paths(batch, world) for batch in batches(world, 48)]
    told, untold = (KernelEstimate(3, weight=1.0, exit_weight=1.0, detection=p) for p in (world.detection, None))
    errors = []
    for estimate in (told, untold):
        for part in paths:
            estimate.add(part)
        estimate.fit(20)
        errors.append(float(np.abs(estimate.mean().toarray()[:, :-1] - world.kernel.toarray()).mean()))
    assert 3 * errors[0] < errors[1]


@pytest.mark.parametrize("name", ["hindsight", "learned_kernel"])
def test_a_safe_action_that_misses_is_not_learned(name: str) -> None:
    with pytest.raises(UserError, match=r"sensor\.p_s=0\.5: expected 1"):
        algorithm(name, replace(small_world(), safe_detection=0.5))


def test_what_counts_paths_is_refused() -> None:
    with pytest.raises(UserError, match=r"algo\.surrogate=sampled: expected all_action"):
        algorithm("ppo_per_sensor", replace(small_world(), detection=0.5), "algo.surrogate=sampled")
    with pytest.raises(UserError, match=r"algo\.surrogate=sampled: expected all_action"):
        algorithm("ppo_per_sensor", replace(small_world(), coverage=np.ones((9, 9))), "algo.surrogate=sampled")
    with pytest.raises(UserError, match=r"algo\.share_cells=all: sensors of different p_d"):
        algorithm("hindsight", replace(small_world(), detection=np.linspace(0.5, 1, 9)), "algo.share_cells=all")
