"""The kernel estimated from detections and misses."""

from __future__ import annotations

import itertools
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from trackmdp.algos.estimates import censored, kernel_estimate
from trackmdp.algos.estimates.censored import ObservedPaths, expected_moves
from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.arrays.types import Array

KERNEL = np.array(
    [[0.0, 0.5, 0.3, 0.0], [0.1, 0.0, 0.0, 0.8], [0.6, 0.0, 0.2, 0.1], [0.3, 0.3, 0.3, 0.0]]
)


def paths_of(rows: list[tuple[int, list[set[int]], int]], choices: int = 2) -> ObservedPaths:
    """From (start, sets of the misses, end)."""
    sensed = np.zeros((len(rows), choices, 4), dtype=bool)
    for k, (_, sets, _) in enumerate(rows):
        for n, cells in enumerate(sets):
            sensed[k, n, sorted(cells)] = True
    start, misses, end = zip(*((x, len(sets), y) for x, sets, y in rows), strict=True)
    sets = sparse.csr_array(sensed.reshape(-1, 4))
    return ObservedPaths(np.array(start), np.array(misses), sets, np.array(end))


def test_moves_that_are_seen_are_counted() -> None:
    estimate = KernelEstimate(2, weight=1e-9, exit_weight=1e-9)
    estimate.add(paths_of([(0, [], 1), (0, [], 1), (0, [], 2), (0, [], 4), (3, [], 0)]))
    estimate.fit(1)
    np.testing.assert_allclose(estimate.mean().toarray()[0], [0.0, 0.5, 0.25, 0.0, 0.25], atol=1e-8)
    np.testing.assert_allclose(estimate.visits, [4, 0, 0, 1])


def test_the_prior_is_the_pooled_displacement() -> None:
    """From 0 the target went right; from 2, never seen, it would go right as well; from 1 it cannot: all is open."""
    estimate = KernelEstimate(2, weight=1.0, exit_weight=1.0)
    estimate.add(paths_of([(0, [], 1)] * 9 + [(0, [], 4)]))
    estimate.fit(1)
    mean = estimate.mean().toarray()
    leave = (1 + 1.5 / 11) / 11
    np.testing.assert_allclose(mean[0], [0, 1 - leave, 0, 0, leave])
    np.testing.assert_allclose(mean[2, :4] / mean[2, :4].sum(), [0, 0, 0, 1])
    np.testing.assert_allclose(mean[1, :4] / mean[1, :4].sum(), [0.25] * 4)
    np.testing.assert_allclose(mean.sum(axis=1), 1.0)
    np.testing.assert_allclose(mean[1:, 4], 1.5 / 11)


def test_a_miss_is_shared_by_the_paths_it_may_have_been() -> None:
    """0 -> ? -> 3, missed with 2 sensed, was through 1; with nothing sensed, through 1 or 2 by their likelihood."""
    estimate = KernelEstimate(2, weight=1e-9, exit_weight=1e-9)
    seen = (
        [(0, [], 1)] * 5
        + [(0, [], 2)] * 5
        + [(1, [], 3)] * 4
        + [(2, [], 3)] * 4
        + [(1, [], 4), (3, [], 4)]
    )
    estimate.add(paths_of([*seen, (0, [{2}], 3), (0, [set()], 3)]))
    estimate.fit(1)
    missed = (estimate.counts - estimate.direct).toarray()
    through = np.array([0.5 * 0.8, 0.5 * 1.0])
    shares = through / through.sum()
    np.testing.assert_allclose(missed[0, 1:3], [1 + shares[0], shares[1]], rtol=0.02)
    np.testing.assert_allclose(missed[[1, 2], 3], [1 + shares[0], shares[1]], rtol=0.02)
    assert missed.sum() == pytest.approx(4.0, abs=1e-3)


def log_likelihood(kernel: Array, rows: list[tuple[int, list[set[int]], int]]) -> float:
    """Summed over all hidden positions, path by path."""
    total = 0.0
    for x, sets, y in rows:
        likelihood = 0.0
        for hidden in itertools.product(range(4), repeat=len(sets)):
            if any(cell in sensed for cell, sensed in zip(hidden, sets, strict=True)):
                continue
            steps = itertools.pairwise((x, *hidden, y))
            likelihood += float(np.prod([kernel[a, b] for a, b in steps]))
        total += np.log(likelihood)
    return total


def simulated(count: int, seed: int) -> list[tuple[int, list[set[int]], int]]:
    """Paths of KERNEL under fixed sets that leave two cells out at n = 0 and one at n = 1; then all are sensed."""
    rng = np.random.default_rng(seed)
    whole = np.hstack([KERNEL, 1 - KERNEL.sum(axis=1, keepdims=True)])
    chain = [{0, 1}, {0, 1, 2}, {0, 1, 2, 3}]
    rows = []
    for _ in range(count):
        start = position = int(rng.integers(4))
        for n, sensed in enumerate(chain):
            position = int(rng.choice(5, p=whole[position]))
            if position == 4 or position in sensed:
                rows.append((start, chain[:n], position))
                break
    return rows


def test_every_round_makes_what_was_seen_more_likely() -> None:
    rows = simulated(300, seed=1)
    estimate, likelihoods = KernelEstimate(2, weight=1e-6, exit_weight=1e-6), []
    estimate.add(paths_of(rows))
    for rounds in (1, 2, 4, 8, 16):
        estimate.fit(rounds)
        likelihoods.append(log_likelihood(estimate.mean().toarray() + 1e-12, rows))
    assert np.diff(likelihoods).min() > -0.1
    assert likelihoods[-1] > likelihoods[0] + 1


def test_paths_taken_part_by_part_give_the_same_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """With masses that are sparse or dense, also where a path's end is an exit or not known."""
    rng, paths = np.random.default_rng(0), paths_of(simulated(200, 0))
    kernel = rng.random((4, 5))
    kernel[2, 1] = 0.0
    given = sparse.csr_array(kernel), replace(paths, end=rng.integers(6, size=200)), rng.random(200)
    whole = expected_moves(*given).toarray()
    for name, number in (("_FULL_ENTRIES", 30), ("_FULL", 2.0), ("_ENTRIES", 30)):
        monkeypatch.setattr(censored, name, number)
        np.testing.assert_allclose(expected_moves(*given).toarray(), whole, rtol=1e-12)


def test_paths_that_exit_need_memory_for_the_cells_where_they_may_be_alone() -> None:
    """On a line of 100,000 cells the target steps to the right or exits; 300 times it was missed once, then left."""
    cells, paths = 100_000, 300
    moves = sparse.diags_array(np.full(cells - 1, 0.9), offsets=1, shape=(cells, cells))
    leave = sparse.csr_array(np.full((cells, 1), 0.1))
    kernel = sparse.csr_array(sparse.hstack([moves, leave], format="csr"))
    seen = ObservedPaths(
        np.arange(paths),
        np.ones(paths, int),
        sparse.csr_array((paths, cells)),
        np.full(paths, cells),
    )
    tracemalloc.start()
    expected = expected_moves(kernel, seen, np.ones(paths))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(expected[:paths, 1 : paths + 1].diagonal(), 1.0)
    np.testing.assert_allclose(expected[1 : paths + 1, [cells]].toarray(), 1.0)
    assert expected.sum() == pytest.approx(2 * paths)
    assert peak < 2**26  # a number for each path and cell would be 2^28 bytes


def test_displacements_are_put_down_part_by_part_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """The typical moves of all cells do not depend on how many are worked on at once."""
    estimate = KernelEstimate((5, 7), weight=1.0, exit_weight=1.0)
    rng = np.random.default_rng(0)
    estimate.add_moves(rng.integers(35, size=40), rng.integers(36, size=40))
    whole = estimate.mean().toarray()
    monkeypatch.setattr(kernel_estimate, "_PLACES", 100)
    np.testing.assert_array_equal(estimate.mean().toarray(), whole)


def test_sets_that_never_show_some_moves_still_tell_them() -> None:
    """Moves to 2 and 3 are never seen at once, but the kernel comes out, within sampling error."""
    estimate = KernelEstimate(2, weight=0.1, exit_weight=1.0)
    estimate.add(paths_of(simulated(20_000, seed=0)))
    assert estimate.direct.toarray()[:, 2:4].sum() == 0
    estimate.fit(200)
    np.testing.assert_allclose(estimate.mean().toarray()[:, :4], KERNEL, atol=0.03)


@pytest.mark.parametrize(("shown", "least", "most"), [(set(), 20, 48), ({0, 1, 2}, 2, 12)])
def test_rounds_go_on_until_the_counts_settle(
    shown: set[int], least: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every path hides one cell. It may be any, which takes many rounds, or must be the one that three others left.

    Leaps lead to where single rounds do.
    """
    rounds = []

    def counted(*given: Any) -> Any:
        rounds.append(expected_moves(*given))
        return rounds[-1]

    def fitted() -> KernelEstimate:
        estimate = KernelEstimate(2, weight=0.1, exit_weight=1.0)
        estimate.add(paths_of([(start, [shown], end) for start, _, end in simulated(2000, 3)]))
        estimate.fit(400)
        return estimate

    monkeypatch.setattr(kernel_estimate, "expected_moves", counted)
    counts = fitted().counts
    assert least <= len(rounds) <= most
    assert abs(rounds[-1] - rounds[-2]).sum() / counts.sum() < 1e-4
    monkeypatch.setattr(kernel_estimate, "_leap", lambda *line: line[-1])
    assert abs(fitted().counts - counts).sum() / counts.sum() < 2e-3


def test_a_leap_goes_to_the_end_of_changes_that_shrink_and_never_below_nothing() -> None:
    """Changes of 2 and 1 lead 4 further; those of 2 and 1.8, ten times 2 further, would leave nothing of the first."""
    ends = (([4, 6], [6, 4], [7, 3], [8, 2]), ([5, 5], [3, 7], [1.2, 8.8], [0.12, 25]))
    for *line, end in ends:
        found = kernel_estimate._leap(*(sparse.csr_array([each]) for each in line)).toarray()[0]
        np.testing.assert_allclose(found, 10 * np.array(end) / np.sum(end))


@pytest.mark.slow
def test_samples_spread_around_the_mean_as_counts_allow() -> None:
    estimate = KernelEstimate(2, weight=1e-6, exit_weight=1e-6)
    estimate.add(paths_of([(0, [], 1)] * 30 + [(0, [], 2)] * 60 + [(0, [], 4)] * 10))
    estimate.fit(1)
    rng = np.random.default_rng(0)
    drawn = np.stack([drawn.toarray()[0] for drawn in estimate.samples(rng, 4000)])
    np.testing.assert_allclose(drawn.mean(axis=0), [0, 0.3, 0.6, 0, 0.1], atol=0.005)
    np.testing.assert_allclose(drawn[:, 2].std(), np.sqrt(0.6 * 0.4 / 101), rtol=0.05)
    np.testing.assert_allclose(drawn[:, 4].std(), np.sqrt(0.1 * 0.9 / 101), rtol=0.05)
    np.testing.assert_allclose(drawn.sum(axis=1), 1.0)


def test_a_saved_estimate_goes_on_as_it_was() -> None:
    first, second = (KernelEstimate(2, weight=0.1, exit_weight=1.0) for _ in range(2))
    first.add(paths_of(simulated(200, seed=2)))
    first.fit(3)
    second.load_state_dict(first.state_dict())
    for estimate in (first, second):
        estimate.add(paths_of(simulated(100, seed=3)))
        estimate.fit(2)
    np.testing.assert_array_equal(first.mean().toarray(), second.mean().toarray())


@pytest.mark.parametrize("fits", [0, 1])
def test_a_state_taken_before_or_after_a_fit_goes_on_with_the_same_bits(fits: int) -> None:
    early = paths_of([(0, [], 1), (0, [{1}], 3), (1, [], 0), (3, [{0}], 2)])
    late = paths_of([(0, [], 2), (2, [], 0), (0, [{1, 2}], 0), (3, [], 1)])
    going, resumed = (KernelEstimate(2, weight=0.1, exit_weight=1.0) for _ in range(2))
    going.add(early)
    for _ in range(fits):
        going.fit(1)
    resumed.load_state_dict(going.state_dict())
    for estimate in (going, resumed):
        estimate.add(late)
    np.testing.assert_array_equal(resumed.mean().toarray(), going.mean().toarray())
    for estimate in (going, resumed):
        estimate.fit(1)
    np.testing.assert_array_equal(resumed.counts.toarray(), going.counts.toarray())
