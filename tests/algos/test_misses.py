"""Learning where sensors miss: what was reported stands for what was not, and policies come near the optimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import sparse

import trackmdp as tm
from tests.algos.hindsight import SOLVES, batches, chain_returns, learn, policy, total
from tests.helpers import algorithm, small_world
from tests.tracks import drawn
from trackmdp.algos.actor_loss import Decision
from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.hindsight_loss import HindsightLoss
from trackmdp.algos.moves import MoveBuffer, report_weights
from trackmdp.algos.observed import observed_paths
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.recordings.tracks import Recorded
from trackmdp.sensing.task import Task
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step

TASK = Task((1, 3), cost=0.1, t_max=0, detection=[1.0, 0.5, 0.25])


def test_weights_are_the_inverse_of_the_probability_of_being_known() -> None:
    weights = report_weights(TASK, torch.device("cpu"))
    assert weights is not None
    assert weights.tolist() == [1.0, 2.0, 4.0, 1.0]
    # of both sensors together: .5, 1 - .5 · .5 and .25
    footprints = [[1.0, 1.0, 0.0], [0.0, 1.0, 0.5]]
    shared = Task((1, 3), cost=0.1, t_max=0, detection=0.5, coverage=footprints)
    weights = report_weights(shared, torch.device("cpu"))
    assert weights is not None
    assert weights.tolist() == pytest.approx([2.0, 4 / 3, 4.0, 1.0])
    assert report_weights(small_world(), torch.device("cpu")) is None


def test_moves_are_drawn_in_proportion_to_their_weights() -> None:
    """Out of cell 0: 4 times to 0, 2 to 1 (each counts 2), 1 to 2 (counts 4), 4 exits: all four alike."""
    buffer = MoveBuffer(TASK, 100, torch.Generator().manual_seed(0))
    start, end = [0] * 11 + [2], [0] * 4 + [1] * 2 + [2] + [3] * 4 + [2]
    buffer.load_state_dict({"moves": torch.tensor([start, end])})
    first, second = buffer.paths(12_000, 1)
    assert torch.bincount(second[first == 0], minlength=4).tolist() == pytest.approx(
        [1000] * 4, abs=1
    )
    assert second[first == 1].unique().tolist() == [3]  # no move was seen out of 1: its paths leave
    assert second[first == 2].unique().tolist() == [2]


def test_returns_take_the_mean_over_the_reports() -> None:
    """At .25 the sensor reports: .25 (1 + .5 · 4) + .75 · .5 · (1 + .5 · 2 - 5), less its price of .1."""
    found = chain_returns(
        torch.tensor([[0.25]]),
        torch.ones(2, 1, dtype=torch.bool),
        torch.tensor([[0.1]]),
        torch.tensor([[4.0], [2.0]]),
        safe_cost=5.0,
        discount=0.5,
    )
    assert found.flatten().tolist() == pytest.approx([0.75 - 1.125 - 0.1, -3.0])


@pytest.mark.slow
@pytest.mark.parametrize("markov", [True, False])
def test_hindsight_comes_near_the_optimum(markov: bool) -> None:
    world = replace(
        small_world(exit_probability=0.02), detection=np.linspace(0.7, 0.95, 9), markov=markov
    )
    learner = learn(
        world, batches(world, 64), *SOLVES, "algo.total_frames=16384", "algo.buffer_size=20000"
    )
    best = optimal.solve(world)
    assert best.certified
    assert regret_per_step(best.upper, evaluate(world, policy(learner, world))) < 0.02


def test_misses_are_censored_moves() -> None:
    """With p_d = .4 for moves to the right half and 1 elsewhere, the moves seen at once are a biased sample."""
    world = replace(
        small_world(exit_probability=0.1), detection=np.where(np.arange(9) % 3 == 2, 0.4, 1.0)
    )
    paths = [observed_paths(batch, world) for batch in batches(world, 48)]
    errors = []
    for known in (True, False):
        estimate = KernelEstimate(3, weight=1.0, exit_weight=1.0)
        for part in paths:
            certain = sparse.csr_array(part.sensed > 0, dtype=np.float64)
            estimate.add(part if known else replace(part, sensed=certain))
        estimate.fit(20)
        errors.append(
            float(np.abs(estimate.mean().toarray()[:, :-1] - world.kernel.toarray()).mean())
        )
    assert 3 * errors[0] < errors[1]


def test_a_safe_action_that_misses_is_repeated() -> None:
    """One set, off; at the end .25 (1 + .5 · 2) + .75 · .5 · -8 - 5 where it misses to go on at -8."""
    found = chain_returns(
        torch.tensor([[0.0]]),
        torch.ones(2, 1, dtype=torch.bool),
        torch.tensor([[0.0]]),
        torch.tensor([[4.0], [2.0]]),
        safe_cost=5.0,
        discount=0.5,
        safe=0.25,
        missed=-8.0,
    )
    assert found.flatten().tolist() == pytest.approx([0.5 * -7.5, -7.5])


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0, 8])
def test_critics_settle_at_the_value_of_what_is_repeated(hidden: int) -> None:
    """Nothing sensed on one cell, r = 1, D = 2, p_s = .5, exit .1, discount .8: L = .9 (.5 (1 + .8 V) + .4 L - 2)."""
    task = Task(1, cost=9.0, safe_cost=2.0, t_max=0, safe_detection=0.5)
    rng = torch.Generator().manual_seed(0)
    loss = HindsightLoss(task, Decision(), reach=0, hidden=hidden, discount=0.8, generator=rng)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.02)
    cells = torch.tensor([[0, 0, 0]] * 81 + [[0, 0, 1]] * 9 + [[0, 1, 1]] * 10).T
    off = torch.zeros(1, 1, 1, dtype=torch.bool)
    for _ in range(1500):
        optimizer.zero_grad()
        losses = total(loss, cells, off, 0.0)
        (losses["critic"] + losses["clocked_critic"]).backward()
        optimizer.step()
    # V = .9 · .8 L, and U is the same: nothing is worth 9.
    exact = np.linalg.solve([[1.0, -0.72], [-0.36, 1 - 0.36]], [0.0, 0.9 * (0.5 - 2)])
    forced = torch.tensor([0.0, loss.credit.forced])
    for net in (loss.critic, loss.clocked_critic):
        assert (net().flatten() + forced).tolist() == pytest.approx(exact.tolist(), abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hindsight", "a2c_per_sensor", "model_based"])
def test_policies_with_a_safe_action_that_misses_come_near_the_optimum(name: str) -> None:
    world = replace(
        small_world(exit_probability=0.02), safe_cost=0.5, detection=0.8, safe_detection=0.5
    )
    words = () if name == "model_based" else (*SOLVES, "algo.buffer_size=20000")
    learner = learn(world, batches(world, 64), "algo.total_frames=16384", *words, name=name)
    best, found = optimal.solve(world), policy(learner, world)
    assert best.certified
    assert regret_per_step(best.upper, evaluate(world, found)) < 0.02
    played = simulate(world, found, 1500, seed=1).figures()
    assert abs(played.aihtr.mean - evaluate(world, found).aihtr) < 3 * played.aihtr.standard_error


def test_what_ends_at_a_safe_action_that_may_miss_is_counted_until_then() -> None:
    """With p_s = .3 most of the time goes by at the last clock; the moves made then are not taken for single ones."""
    world = replace(small_world(exit_probability=0.1), detection=0.4, safe_detection=0.3)
    estimate = KernelEstimate(3, weight=1.0, exit_weight=1.0)
    for batch in batches(world, 96):
        paths = observed_paths(batch, world)
        assert ((paths.end == 10) == (paths.misses == 2)).all()
        estimate.add(paths)
    estimate.fit(40)
    assert np.abs(estimate.mean().toarray()[:, :-1] - world.kernel.toarray()).mean() < 0.02
    assert estimate.mean().toarray()[:, -1].mean() == pytest.approx(0.1, abs=0.015)


def test_what_counts_paths_is_refused() -> None:
    with pytest.raises(UserError, match=r"algo\.surrogate=sampled: expected all_action"):
        algorithm("ppo_per_sensor", replace(small_world(), detection=0.5), "algo.surrogate=sampled")
    with pytest.raises(UserError, match=r"algo\.surrogate=sampled: expected all_action"):
        algorithm(
            "ppo_per_sensor",
            replace(small_world(), coverage=np.ones((9, 9))),
            "algo.surrogate=sampled",
        )
    with pytest.raises(UserError, match=r"algo\.share_cells=all: sensors of different p_d"):
        algorithm(
            "hindsight",
            replace(small_world(), detection=np.linspace(0.5, 1, 9)),
            "algo.share_cells=all",
        )


def test_cells_too_dear_to_sense_are_left_out_where_sensors_miss() -> None:
    """On recorded tracks, two cells of price 1e6: better than Q_MDP of the estimated kernel, and than nothing."""
    kernel, cost = small_world(exit_probability=0.02).kernel, np.full(9, 0.1)
    cost[[1, 5]] = 1e6
    parts = {"validation": drawn(kernel, 40, 2), "held_out": drawn(kernel, 40, 3)}
    task = {"cost": cost, "safe_cost": 2.0, "t_max": 1, "detection": 0.9}
    problem = Recorded(drawn(kernel, 100, 1), 3, **parts, **task)
    run = tm.train(problem, total_frames=10_000)
    assert not run.policy.dense()[..., [1, 5]].any()
    q_mdp, none = tm.compare(problem, [run, "qmdp", "none"]).policies[1:]
    assert max(q_mdp.difference.mean, none.difference.mean) < 0
