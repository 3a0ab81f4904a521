"""When the loop saves."""

from __future__ import annotations

import pytest

from trackmdp.training.loop import Intervals, Position, _due


@pytest.mark.parametrize(
    ("frames", "seconds", "rest", "due"),
    [
        (0, 29.0, 0.0, False),
        (0, 30.0, 0.0, True),
        (0, 99.0, 100.0, False),
        (0, 100.0, 100.0, True),
        (999, 1.0, 0.0, False),
        (1000, 1.0, 100.0, True),
    ],
)
def test_saved_by_frames_or_by_time_but_not_most_of_the_time(
    frames: int, seconds: float, rest: float, due: bool
) -> None:
    every = Intervals(evaluate=1, log=1, save_frames=1000, save_seconds=30.0)
    start = Position(10, 5000, 500.0)
    assert _due(start, Position(11, 5000 + frames, 500.0 + seconds), rest, every) is due


def test_neither_by_frames_nor_by_time() -> None:
    every = Intervals(evaluate=1, log=1, save_frames=0, save_seconds=None)
    assert not _due(Position(), Position(10, 10**9, 10.0**9), 0.0, every)
