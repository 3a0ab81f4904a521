"""The motion after a cell and a move, by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

import trackmdp as tm
from tests.tracks import by_hand
from trackmdp.algos.estimates.last_moves import (
    after_moves,
    displacements,
    heading_after,
    headings,
)
from trackmdp.recordings.tracks import Tracks

TASK = tm.World(np.full((3, 3), 0.3), (1, 3), cost=0.16, t_max=1, memory="displacement")
TRACKS = Tracks(
    np.array([0, 1, 2, 2, 1, 0]), np.array([0, 3, 6]), np.array([True, False]), np.arange(2)
)
"""From the left to the right and out of the grid; from the right to the left, where the recording stops."""
POOLED = sparse.csr_array([[0, 0.5, 0, 0.5], [0.5, 0, 0.5, 0], [0.25, 0.25, 0, 0.5]])


def test_moves_after_a_cell_and_a_move_are_counted_and_the_pooled_ones_count_as_three() -> None:
    """States: cell, and twice the place of the last move among (left, stop, right), one more after a stop.

    From cell 1 after a move to the right: (1 + 1.5) / 4 right, 1.5 / 4 left. The move of two cells from cell 2, which
    was never seen, is left out.
    """
    world = after_moves(TASK, TRACKS, POOLED, 0.0)
    assert (world.modes, world.memory, world.revealed) == (6, "displacement", 1)
    left, right = (0, 6, 12), (4, 10, 16)
    expected = np.zeros((18, 18))
    expected[:6, right[1]] = 0.5
    expected[6:12, [left[0]]] = expected[6:12, [right[2]]] = 0.5
    expected[left[1], [left[0], right[2]]] = [0.625, 0.375]
    expected[right[1], [left[0], right[2]]] = [0.375, 0.625]
    expected[12:, left[1]] = 0.25
    expected[right[2], left[1]] = 0.75 / 4  # the exit was seen once
    assert world.kernel.toarray() == pytest.approx(expected)


def test_after_two_moves_those_after_the_last_one_count_as_three() -> None:
    """Modes: none and then each of the 6 headings, and right after right, the one other pair that was seen.

    From cell 1 after none and right, right was seen once: (1 + 3 · 0.625) / 4. After right twice nothing was seen in
    cell 1, and the exit from cell 2: 3 / 4 of the chance after right.
    """
    world = after_moves(TASK, TRACKS, POOLED, 0.0, 2)
    assert world.modes == 7
    kernel = world.kernel.toarray().reshape(3, 7, 3, 7)
    cells = kernel.sum(axis=3)
    left, right, again = 0, 4, 6
    assert cells[1, left] == pytest.approx([2.875 / 4, 0, 1.125 / 4])
    assert cells[1, right] == pytest.approx([1.125 / 4, 0, 2.875 / 4])
    assert cells[1, again] == pytest.approx([0.375, 0, 0.625])
    assert cells[2, again] == pytest.approx([0, 0.75 * 0.75 / 4, 0])
    # Left after left was never followed by a move: it counts as left after none.
    assert kernel[1, right, 2].nonzero()[0].tolist() == [again]
    assert kernel[1, left, 0].nonzero()[0].tolist() == [left]


def test_a_stop_keeps_the_last_move_and_is_known() -> None:
    """0 1 1 2: no move, right, right and a stop, right; 1 1, and 2 2 after it: no move, no move and a stop."""
    line = by_hand([0, 1, 1, 2], [1, 1], [2, 2])
    moves = displacements(TASK, *line.steps(3))
    assert headings(TASK, line, moves).tolist() == [0, 2, 3, 2, 0, 1, 0, 1]
    assert heading_after(
        TASK, moves, np.array([2, 2]), np.array([1, 1]), np.array([1, 2])
    ).tolist() == [3, 2]


def test_displacements_are_those_seen() -> None:
    """A stop, one cell to the left and to the right; on a square, down and to the right are two moves."""
    assert len(displacements(TASK, *TRACKS.steps(3))) == 3
    square = tm.make_world("random_walk", size=3)
    assert len(displacements(square, np.array([0, 0]), np.array([3, 1]))) == 3


@pytest.mark.slow
def test_a_heading_is_learned_from_its_moves() -> None:
    """Plans on paths alone stop .004 to .009 a step below the policy found on the motion."""
    world = tm.make_world("constant_velocity", size=3, memory="displacement")
    best = tm.evaluate(world, tm.solve(world).policy)
    run = tm.train(world, "model_based", seed=11, **{"optimal.enabled": False})
    regret = best.aihtr - tm.evaluate(world, run.policy).aihtr
    assert regret / best.expected_length < 0.004
