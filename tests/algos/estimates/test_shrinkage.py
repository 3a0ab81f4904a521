"""Moves estimated by empirical Bayes: nearer to the truth, with a true share for what is new, and better plans."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.algos.estimates.shrinkage import least_worth_planning, posterior_mean, unseen, without
from trackmdp.arrays.entries import row_index
from trackmdp.grid.displacements import apart
from trackmdp.solvers import exchange, optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.make import make_world
from trackmdp.world.model import World


def counts_of(world: World, each: int, seed: int) -> sparse.csr_array:
    """`[M, M + 1]`, `each` moves drawn out of every cell."""
    rng, kernel = np.random.default_rng(seed), world.kernel.toarray()
    rows = np.concatenate([kernel, 1.0 - kernel.sum(axis=1, keepdims=True)], axis=1)
    return sparse.csr_array(np.stack([rng.multinomial(each, row) for row in rows]).astype(float))


def estimate_of(world: World, counts: sparse.csr_array) -> KernelEstimate:
    estimate = KernelEstimate(world.size, weight=0.1, exit_weight=100.0, share_cells=None)
    start, end = counts.nonzero()
    times = counts.data.astype(int)
    estimate.add_moves(np.repeat(start, times), np.repeat(end, times))
    return estimate


def test_probabilities_of_two_kinds_are_told_apart() -> None:
    """A thousand moves of .15 and as many of .21, 300 times each: raw shares err by .02, more than their spread."""
    rng, truth = np.random.default_rng(0), np.repeat([0.15, 0.21], 1000)
    count = rng.binomial(300, truth).astype(float)
    raw, found = count / 300, posterior_mean(count, np.full(2000, 300.0))
    assert np.square(found - truth).mean() < 0.8 * np.square(raw - truth).mean()
    # what is seen more often is likelier, whatever the others are
    assert (np.diff(found[np.argsort(count, kind="stable")]) >= -1e-12).all()


def test_many_moves_speak_for_themselves() -> None:
    rng = np.random.default_rng(1)
    count = rng.binomial(10**6, rng.random(50) ** 3).astype(float) + 1
    np.testing.assert_allclose(
        posterior_mean(count, np.full(50, 1e6 + 1)), count / (1e6 + 1), rtol=0, atol=3e-5
    )


def test_more_pairs_than_are_fitted_at_once_give_nearly_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    moves = rng.integers(100, 400, 3000).astype(float)
    count = rng.binomial(moves.astype(int), 0.1 + 0.3 * rng.random(3000)) + 1.0
    whole = posterior_mean(count, moves)
    monkeypatch.setattr("trackmdp.algos.estimates.shrinkage.MOST_PAIRS", 500)
    np.testing.assert_allclose(posterior_mean(count, moves), whole, atol=0.02)


def test_what_is_new_by_hand() -> None:
    """Of ten moves, two cells were reached once, one eight times: twice .1 · .9^10 / (1 - .9^10) and hardly more."""
    new, stands_for = unseen(np.zeros(3, dtype=int), np.array([0.1, 0.1, 0.8]), np.full(3, 10.0), 2)
    each = 0.1 * 0.9**10 / (1 - 0.9**10)
    np.testing.assert_allclose(stands_for, [each, each, 0.8 * 0.2**10 / (1 - 0.2**10)], rtol=1e-9)
    np.testing.assert_allclose(new, [stands_for.sum() / (1 + stands_for.sum()), 1.0])


def test_a_cell_that_was_always_left_alike_may_be_left_otherwise() -> None:
    """Ten times each; what is new after ten moves is the mean of both cells, and of a third, left 20 times, less."""
    probability, moves = np.array([0.1, 0.1, 0.8, 1.0, 1.0]), np.array([10.0, 10, 10, 10, 20])
    new, _ = unseen(np.array([0, 0, 0, 1, 2]), probability, moves, 3)
    stood_for = np.array([0.1, 0.1, 0.8]) / (1 - np.array([0.9, 0.9, 0.2]) ** 10)
    ten, twenty = (stood_for @ np.array([0.9, 0.9, 0.2]) ** number / 3 for number in (10, 20))
    np.testing.assert_allclose(
        new, [ten / (1 + ten), ten / (1 + ten), twenty / (1 + twenty)], rtol=1e-6
    )
    assert new[1] > 2 * new[2] > 0.02


@given(st.integers(0, 2**32 - 1), st.integers(0, 30))
def test_rows_are_probabilities_and_no_seen_move_is_lost(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    estimate = KernelEstimate(
        (3, 4), weight=0.1, exit_weight=1.0, share_cells=(None, True, False)[seed % 3]
    )
    estimate.add_moves(rng.integers(12, size=most), rng.integers(13, size=most))
    rows = estimate.believed()
    np.testing.assert_allclose(rows.sum(axis=1), 1.0)
    assert (rows.data > 0).all()
    assert not ((estimate.counts[:, :-1] > 0).toarray() & (rows[:, :-1].toarray() == 0)).any()


def test_the_order_in_which_counts_are_stored_changes_nothing() -> None:
    """Sums of sparse matrices need not be sorted; with SciPy 1.15 those of censored moves are not."""
    counts = counts_of(make_world("random_support", size=4, cost=0.2), 10, 4)
    estimate = KernelEstimate(4, weight=0.1, exit_weight=1.0)
    estimate.counts = counts
    expected = estimate.believed().toarray()
    # Row by row, the columns of each from the last.
    order = np.lexsort((-counts.indices, row_index(counts)))
    estimate.counts = sparse.csr_array(
        (counts.data[order], counts.indices[order], counts.indptr), shape=counts.shape
    )
    np.testing.assert_allclose(estimate.believed().toarray(), expected, rtol=1e-12)


def test_new_moves_are_expected_where_little_was_seen() -> None:
    world = make_world("random_support", size=10, cost=0.2)
    few, many = (estimate_of(world, counts_of(world, each, 3)) for each in (10, 1000))
    for estimate, low, high in ((few, 0.03, 0.2), (many, 0.0, 1e-12)):
        believed, new = (
            estimate.believed()[:, :-1].toarray(),
            estimate.counts[:, :-1].toarray() == 0,
        )
        missing, expected = (world.kernel.toarray() * new).sum(), (believed * new).sum()
        assert low <= expected / 100 <= high
        # about as likely as it is: a first estimate, from few
        assert expected == pytest.approx(missing, rel=1.0, abs=1e-9)


def test_rare_moves_are_planned_without_as_the_prices_say() -> None:
    cheap, dear = (
        make_world("random_walk", size=3, cost=0.2, safe_cost=cost) for cost in (19.0, 1999.0)
    )
    assert least_worth_planning(cheap) == pytest.approx(0.01 * 0.2 / 20)
    assert least_worth_planning(dear) == pytest.approx(0.01 * 0.2 / 2000)
    kernel = sparse.csr_array(np.array([[0.5, 0.3, 0.1], [0.2, 0.2, 0.2], [0.0, 0.0, 0.5]]))
    # .1 goes, and the others share it 5 to 3; where all would go they stay
    np.testing.assert_allclose(
        without(kernel, 0.25).toarray(), [[0.5625, 0.3375, 0], [0.2, 0.2, 0.2], [0, 0, 0.5]]
    )


def test_nothing_is_sensed_for_the_prior_where_a_miss_is_dear() -> None:
    """With D = 1000 a tenth of a move out of 300 makes plans sense what never happens: .018 a step against .002."""
    world = make_world("random_support", size=10, cost=0.22, safe_cost=1000.0)
    estimate, best = estimate_of(world, counts_of(world, 300, 101)), optimal.solve(world)
    least = least_worth_planning(world)
    lost = []
    for believed in (estimate.mean(), estimate.believed(least)):
        plan = exchange.solve(
            World.of(world, without(sparse.csr_array(believed[:, :-1]), least), max_steps=None)
        )
        found = evaluate(world, plan)
        lost.append((best.upper - found.aihtr) / found.expected_length)
    assert lost[1] < 0.005
    assert lost[0] > 3 * lost[1]


def test_far_jumps_are_no_guide_to_steps_nearby() -> None:
    """Of 6 x 10 cells, each with steps of any probability and three jumps of .1 anywhere: those are found to be alike.

    One mixture for all moves leaves the jumps with .6 of the error of their shares.
    """
    rng, cell = np.random.default_rng(0), np.arange(60)
    far = apart(10, cell[:, None], cell) > 1
    kernel = ~far * rng.uniform(0.05, 1.0, far.shape)
    kernel *= 0.7 / kernel.sum(axis=1, keepdims=True)
    for start in cell:
        kernel[start, rng.choice(np.flatnonzero(far[start]), 3, replace=False)] = 0.1
    count = np.stack([rng.multinomial(200, row) for row in kernel])
    start, end = count.nonzero()
    estimate = KernelEstimate((6, 10), weight=0.1, exit_weight=1.0)
    times = count[start, end]
    estimate.add_moves(np.repeat(start, times), np.repeat(end, times))
    believed, jumps = estimate.believed()[:, :-1].toarray(), far & (count > 0)
    assert np.abs(believed - 0.1)[jumps].mean() < 0.5 * np.abs(count / 200 - 0.1)[jumps].mean()
