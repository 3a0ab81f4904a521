"""Learning while the policy learned so far collects."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch

from tests.algos.hindsight import SHORT, SOLVES, assert_same, batches, learn, policy
from tests.helpers import algorithm, collect, later, random_state, small_world
from trackmdp.motion.kernels import random_walk
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.training.train import train
from trackmdp.world.model import World

MIXED = (
    "algo.collect=mixed",
    "algo.explore.begin=0.25",
    "algo.explore.until=0.75",
    "algo.explore.end=0.1",
)


def test_mixed_learns_while_it_collects() -> None:
    """Of 16 batches 4 are sensed whole; the 12 others come with 10 updates each, and 20 are left."""
    world = small_world()
    learner = algorithm("hindsight", world, *SHORT, *MIXED, "algo.updates=140")
    assert learner.iterations == 16 + 2
    explore, updates = [], []
    for batch in [*batches(world), None, None]:
        updates.append(learner.step(batch)["updates"])
        explore.append(learner.policy.explore.item())
        if updates[-1]:
            rows = random_state(world, 50, seed=0)
            learner.policy.explore.zero_()
            acts = [each(rows.clone())["action"] for each in (learner.policy, learner.actor)]
            assert torch.equal(*acts)
    assert updates == [0] * 4 + list(range(10, 150, 10))
    assert explore[:4] == [1.0] * 4
    assert explore[4:12] == pytest.approx(np.linspace(1, 0.1, 9)[1:], abs=1e-6)
    assert explore[12:] == pytest.approx([0.1] * 6)
    half = algorithm("hindsight", world, *SHORT, *MIXED, "algo.explore.start=0.5")
    assert half.policy.explore.item() == 0.5


@pytest.mark.slow
def test_mixed_reaches_the_optimum_of_a_small_world() -> None:
    """Each batch is collected with the policy learned so far."""
    world = small_world(exit_probability=0.02)
    learner = algorithm(
        "hindsight",
        world,
        *SOLVES,
        *MIXED,
        "algo.updates_per_iteration=25",
        "algo.total_frames=8192",
    )
    torch.manual_seed(0)
    earned = []
    for number in range(learner.iterations):
        frames = collect(world, learner.policy, 32, 8, seed=number) if number < 32 else None
        earned += [] if frames is None else [frames["next", "reward"].mean().item()]
        learner.step(frames)
    best = optimal.solve(world, nodes=1_000_000)
    assert regret_per_step(best.upper, evaluate(world, policy(learner, world))) < 0.01
    assert np.mean(earned[-8:]) > np.mean(earned[:8]) + 0.5


@pytest.mark.parametrize("saved_at", [3, *later([8])])
def test_a_resumed_mixture_goes_on_with_the_same_policy(saved_at: int) -> None:
    world, words = small_world(), (*SHORT, *MIXED, "algo.updates=130")
    data = [*batches(world), None]
    whole, begun, resumed = (algorithm("hindsight", world, *words) for _ in range(3))
    for batch in data:
        whole.step(batch)
    for batch in data[:saved_at]:
        begun.step(batch)
    file = io.BytesIO()
    torch.save(begun.state_dict(), file)
    file.seek(0)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert_same(begun.policy.state_dict(), resumed.policy.state_dict())
    for batch in data[saved_at:]:
        resumed.step(batch)
    assert_same(whole.state_dict(), resumed.state_dict())
    assert_same(whole.policy.state_dict(), resumed.policy.state_dict())


def test_the_first_frames_of_a_mixture_decide_how_far_the_nets_see() -> None:
    """Later the target jumps from the upper half of the grid to its last cell: learning goes on as if it had left."""
    world = small_world(size=5)
    jumps, leaves = batches(world), batches(world)
    for number in range(16):
        first = jumps[number]["last_cell"]
        far = (first < 12) & (number >= 5)
        near = torch.where(first % 5 < 4, first + 1, first - 1)
        jumps[number]["next", "last_cell"] = torch.where(far, 24, near)
        leaves[number]["next", "last_cell"] = near
        for batch, exits in ((jumps[number], torch.zeros_like(far)), (leaves[number], far)):
            batch["next", "terminated"] = exits.unsqueeze(-1)
    # Without the exchange, which counts moves of any length.
    words = (*SHORT, *MIXED, "algo.hidden=8", "algo.exchange=false")
    one, other = learn(world, jumps, *words), learn(world, leaves, *words)
    assert [learner._reach() for learner in (one, other)] == [4, 1]
    assert np.array_equal(policy(one, world).dense(), policy(other, world).dense())
    parts = zip(one._learner.loss.parameters(), other._learner.loss.parameters(), strict=True)
    assert all(torch.equal(mine, theirs) for mine, theirs in parts)


@pytest.mark.slow
@pytest.mark.parametrize("collects", ["all_on", "mixed"])
def test_a_window_that_holds_every_move_costs_nothing(collects: str) -> None:
    """Moves of one cell and t_max = 0: sensors farther away are of no use, so that the window changes no optimum."""
    kernel = random_walk(5, stay=0.2, diagonal=True, exit_probability=0.02, border="renormalize")
    words = {
        "total_frames": 20_000,
        "frames_per_batch": 1000,
        "envs": 100,
        "updates": 300,
        "collect": collects,
    }
    for window in (None, 1):
        world = World(kernel, 5, cost=0.1, t_max=0, window=window)
        run = train(world, "hindsight", optimal={"enabled": False}, **words)
        assert run.columns["moves"][-1] > 2000
        assert run.summary["regret_per_step"] < 0.01
        assert window is None or len(run.policy.sets.indices) < 9 * 25
