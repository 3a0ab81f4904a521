"""The belief filter against hand numbers, against all paths, and against what the environment does."""

from __future__ import annotations

import itertools
import tracemalloc

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from tests.helpers import random_kernel, small_world
from trackmdp.environment.env import TrackEnv
from trackmdp.episodes.belief_filter import beliefs
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.belief import BeliefFilter
from trackmdp.world.make import make_world

KERNEL = sparse.csr_array(
    [[0.2, 0.3, 0.4, 0.0], [0.5, 0.0, 0.0, 0.25], [0.0, 0.0, 0.5, 0.5], [0.1, 0.1, 0.1, 0.1]]
)


def test_two_steps_by_hand() -> None:
    belief = BeliefFilter(KERNEL)
    start = belief.detect(np.array([0, 3]))
    assert start.tolist() == [[1, 0, 0, 0], [0, 0, 0, 1]]
    assert start.dtype == np.float64
    predicted = belief.predict(start)
    np.testing.assert_allclose(predicted, [[0.2, 0.3, 0.4, 0.0], [0.1] * 4])
    action = np.array([[True, False, False, True], [False, False, True, False]])
    missed = belief.miss(predicted, action)
    np.testing.assert_allclose(missed, [[0, 3 / 7, 4 / 7, 0], [1 / 3, 1 / 3, 0, 1 / 3]])
    again = belief.predict(missed)
    np.testing.assert_allclose(again[0], [3 / 14, 0, 2 / 7, 3 / 28 + 2 / 7])
    np.testing.assert_allclose(again[0].sum(), 3 / 7 * 0.75 + 4 / 7)


def test_a_miss_that_cannot_happen_leaves_the_prediction() -> None:
    belief = BeliefFilter(KERNEL)
    predicted = belief.predict(belief.detect(np.array([0])))
    after = belief.miss(predicted, np.ones((1, 4), dtype=bool))
    np.testing.assert_allclose(after, predicted / 0.9)
    nothing = belief.miss(np.zeros((1, 4)), np.ones((1, 4), dtype=bool))
    assert np.isfinite(nothing).all()


def test_a_tiny_mass_still_counts() -> None:
    predicted = np.array([[1.0, 1e-200, 3e-200, 0.0]])
    after = BeliefFilter(KERNEL).miss(predicted, np.array([[True, False, False, False]]))
    np.testing.assert_allclose(after, [[0, 0.25, 0.75, 0]])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-6, 0.4]), st.integers(1, 4))
def test_it_is_the_posterior_over_all_paths(seed: int, exit_probability: float, steps: int) -> None:
    """Weigh every path of a 4-cell world by its probability, keep those that dodge the sensors."""
    rng = np.random.default_rng(seed)
    kernel, start = random_kernel(rng, 4, exit_probability), int(rng.integers(4))
    actions = rng.random((steps, 4)) < 0.4
    weight = np.zeros(4)
    for path in itertools.product(range(4), repeat=steps):
        moves = list(itertools.pairwise((start, *path)))
        dodged = all(not action[cell] for action, cell in zip(actions, path, strict=True))
        weight[path[-1]] += dodged * np.prod([kernel[move] for move in moves])
    belief = BeliefFilter(sparse.csr_array(kernel))
    rows = belief.detect(np.array([start]))
    for action in actions:
        rows = belief.miss(belief.predict(rows), action[None])
        assert np.isfinite(rows).all()
        np.testing.assert_allclose(rows.sum(), 1.0)
    if weight.sum() > 0:
        np.testing.assert_allclose(rows[0], weight / weight.sum(), atol=1e-12)


def test_it_says_where_the_environments_targets_are() -> None:
    """200,000 targets from cell 4, two fixed subsets, both missed: the cells they stand in, within five deviations."""
    world, count = small_world(t_max=2, exit_probability=0.2), 200_000
    env = TrackEnv(world, count, seed=1)
    env.reset()
    there = env.snapshot()
    there["rows"] |= dict.fromkeys(("place", "last_cell"), torch.full((count,), 4))
    state = env.restore(there)
    belief = BeliefFilter(world.kernel)
    rows = belief.detect(np.array([4]))
    for cells in ([0, 1, 8], [4, 5]):
        action = torch.zeros(1, 9, dtype=torch.bool)
        action[0, cells] = True
        state = env.step(state.set("action", action.expand(count, 9)))["next"]
        rows = belief.miss(belief.predict(rows), action.numpy())
    missed = (state["steps_since_detection"] == 2) & ~state["terminated"].squeeze(-1)
    counts = np.bincount(env.target[missed], minlength=9)
    assert counts.sum() > 20_000
    p = rows[0]
    assert (abs(counts - counts.sum() * p) <= 5 * np.sqrt(counts.sum() * p * (1 - p))).all()


def test_a_long_episode_takes_no_probabilities_of_all_its_steps_at_once() -> None:
    world = make_world("random_walk", size=40, detection=0.8, exit_probability=0.003)
    (episode,) = simulate(world, "none", 1, seed=2)
    tracemalloc.start()
    beliefs(world, [episode])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(episode) > 100
    # The result takes 4 bytes for each, the copy of all actions one, probabilities would take 8 more.
    assert peak < 8 * len(episode) * world.num_cells
