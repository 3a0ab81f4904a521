"""Moves pooled over cells from which the target moves alike."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from trackmdp.solvers.alike import AlikeCells
from trackmdp.solvers.kernel_estimate import KernelEstimate
from trackmdp.world.make import make_world
from trackmdp.world.model import Array


def counts_of(kernel: Array, moves: int, seed: int = 0) -> sparse.csr_array:
    """`[M, M + 1]`, `moves` drawn out of each cell."""
    rng = np.random.default_rng(seed)
    rows = np.c_[kernel, 1.0 - kernel.sum(axis=1)]
    return sparse.csr_array(np.stack([rng.multinomial(moves, row) for row in rows]).astype(float))


def test_cells_as_far_from_the_borders_share_their_moves() -> None:
    """3 rows of 6 cells, moves of one: 8 and 9 are inner cells, as are 7 and 10; 13 lies at the lower border."""
    counts = sparse.csr_array((18, 19))
    seen = sparse.lil_array(counts)
    seen[8, 9], seen[8, 18], seen[9, 15], seen[13, 14] = 3, 1, 2, 5
    pooled = AlikeCells((3, 6), 1).pooled(sparse.csr_array(seen)).toarray()
    for cell in (7, 8, 9, 10):
        expected = np.zeros(19)
        expected[[cell + 1, cell + 6, 18]] = 3, 2, 1
        np.testing.assert_array_equal(pooled[cell], expected)
    assert pooled[14, 15] == 5
    assert pooled.sum() == 4 * 6 + 4 * 5


@pytest.mark.parametrize(("kind", "alike"), [("drift", True), ("random_walk", True), ("random_support", False)])
@pytest.mark.parametrize("moves", [30, 3000])
def test_the_moves_seen_say_which_cells_are_alike(kind: str, moves: int, *, alike: bool) -> None:
    kernel = make_world(kind, size=10).kernel.toarray()
    found = AlikeCells((10, 10), 1, counts_of(kernel, moves))
    assert len(found.first) == (9 if alike else 100)


def test_pooled_estimates_are_nearer_to_the_motion() -> None:
    kernel = make_world("drift", size=10).kernel.toarray()
    estimates = [KernelEstimate(10, weight=0.1, exit_weight=1.0, share_cells=shared) for shared in (False, True, None)]
    errors = []
    for estimate in estimates:
        estimate.direct = estimate.counts = counts_of(kernel, 300)
        errors.append(np.abs(estimate.mean()[:, :-1].toarray() - kernel)[33])
    assert errors[1].max() < 0.4 * errors[0].max()
    np.testing.assert_array_equal(errors[1], errors[2])


def test_alike_cells_are_drawn_once() -> None:
    estimate = KernelEstimate(10, weight=0.1, exit_weight=1.0, share_cells=True)
    estimate.direct = estimate.counts = counts_of(make_world("random_walk", size=10).kernel.toarray(), 30)
    first, second = (estimate.sample(np.random.default_rng(seed)).toarray() for seed in (0, 1))
    np.testing.assert_array_equal(first[44, [43, 45, 34, 54]], first[55, [54, 56, 45, 65]])
    assert first[44, 45] != second[44, 45]
    np.testing.assert_allclose(first.sum(axis=1), 1.0)


def test_a_drawn_kernel_has_a_way_out_though_no_exit_was_seen() -> None:
    """The exit's posterior after 50 moves from each cell is Beta(0.01, 150): most draws are 0 but for rounding."""
    estimate = KernelEstimate(3, weight=0.1, exit_weight=100.0)
    moves = np.tile(np.arange(9), 50)
    estimate.add_moves(moves, np.roll(np.arange(9), 1)[moves])
    for seed in range(5):
        assert estimate.sample(np.random.default_rng(seed)).toarray()[:, 9].min() >= 1e-9
