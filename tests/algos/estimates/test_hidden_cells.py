"""The last moves of targets, by hand."""

from __future__ import annotations

import numpy as np

import trackmdp as tm
from tests.tracks import by_hand
from trackmdp.algos.estimates.hidden_cells import Moves
from trackmdp.recordings.tracks import Tracks

TASK = tm.World(np.full((3, 3), 0.3), (1, 3), cost=0.16, t_max=1, memory="displacement")
TRACKS = Tracks(
    np.array([0, 1, 2, 2, 1, 0]), np.array([0, 3, 6]), np.array([True, False]), np.arange(2)
)
"""From the left to the right and out of the grid; from the right to the left, where the recording stops."""


def sensed(task: tm.Task, line: Tracks) -> Moves:
    return Moves(task, line, np.zeros(len(line.cells), dtype=bool))


def test_a_stop_keeps_the_last_move_and_is_known() -> None:
    """0 1 1 2: no move, right, right and a stop, right; 1 1, and 2 2 after it: no move, no move and a stop."""
    line = by_hand([0, 1, 1, 2], [1, 1], [2, 2])
    moves = sensed(TASK, line)
    assert moves.headings(line).tolist() == [0, 2, 3, 2, 0, 1, 0, 1]
    after = moves.heading_after(np.array([2, 2]), np.array([1, 1]), np.array([1, 2]))
    assert after.tolist() == [3, 2]


def test_a_shift_has_a_number() -> None:
    """On 3 x 4 cells 9 for each row down and 1 for each column to the right: from 5 to 10, to 2, to 4 and to 8."""
    moves = sensed(tm.make_world("random_walk", size=(3, 4)), by_hand([0, 1]))
    ends = np.array([10, 2, 4, 8])
    assert moves.shift(np.array([5]), ends).tolist() == [9 + 1, -9 + 1, -1, 9 - 1]
    assert moves.shift(np.array([[5], [6]]), ends).shape == (2, 4)


def test_displacements_are_those_seen() -> None:
    """A stop, one cell to the left and to the right; on a square, down and to the right are two moves."""
    assert len(sensed(TASK, TRACKS).moves) == 3
    square = tm.make_world("random_walk", size=3)
    assert len(sensed(square, by_hand([0, 3], [0, 1])).moves) == 3
