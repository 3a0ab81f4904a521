"""What sensors with footprints gain given those that are on, against the definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from trackmdp.algos.in_view import SensorsInView
from trackmdp.world.coverage import discs
from trackmdp.world.model import Task
from trackmdp.world.windows import Window

LINE = Task((1, 4), cost=0.1, t_max=0, coverage=[[1, 1, 1, 0], [0, 0, 1, 1]])


def test_sensors_of_a_line_by_hand() -> None:
    """Windows (-, 0, 1), (0, 1, 2), (1, 2, 3), (2, 3, -); from the first, sensor 0 alone can see the target."""
    view = SensorsInView(LINE, Window(LINE, 1))
    assert view.numbers.tolist() == [[0, 2], [0, 1], [0, 1], [0, 1]]
    gain, on = torch.zeros(4, 1, 9), torch.tensor([[[True, False]], [[True, True]]] * 2)
    gain[..., 3:6] = torch.tensor([1.0, 2.0, 4.0])  # the rows above and below lie outside
    # From cell 0 sensor 0 sees 2 + 4. From 1 it alone sees 1 + 2, both see 4; from 2, where it is on, 1 + 2, and the
    # other one 4 more; from 3, with both on, both see 1, and 2 is seen by sensor 1 alone.
    assert view.gains(gain, on, slice(None)).squeeze(1).tolist() == [[6, 0], [3, 0], [3, 4], [0, 2]]
    assert view.seen(on[1:3], slice(1, 3))[:, 0, 3:6].tolist() == [[True, True, True], [True, True, False]]


@pytest.mark.parametrize("radius", [None, 1])
def test_gains_are_what_a_set_is_worth_more(radius: int | None) -> None:
    places = np.array([(0, 0), (0, 1), (1, 2), (2, 2), (3, 0), (3, 3)])
    task = Task(4, cost=0.1, t_max=1, coverage=discs((4, 4), places, 1.5))
    covers = task.covered(np.eye(6, dtype=bool))
    window = Window(task, radius)
    view, rng = SensorsInView(task, window), torch.Generator().manual_seed(0)
    gain = torch.randn(16, 2, window.width, dtype=torch.float64, generator=rng)
    on = torch.rand(16, 2, view.width, generator=rng) < 0.4
    found = view.gains(gain, on, slice(None))
    for x, n in np.ndindex(16, 2):
        cells = {int(c): float(gain[x, n, i]) for i, c in enumerate(window.cells[x]) if c < 16}
        chosen = {int(s) for s, yes in zip(view.numbers[x], on[x, n], strict=True) if yes and s < 6}

        def worth(sensors: set[int], cells: dict[int, float] = cells) -> float:
            return sum(each for cell, each in cells.items() if covers[list(sensors), cell].any())

        seeing = {int(s) for s in view.numbers[x] if s < 6}
        assert seeing == {s for s in range(6) if covers[s, list(cells)].any()}
        for place, sensor in enumerate(view.numbers[x].tolist()):
            more = 0.0 if sensor == 6 else worth(chosen | {sensor}) - worth(chosen - {sensor})
            assert float(found[x, n, place]) == pytest.approx(more, abs=1e-12)


def test_a_sensor_in_each_cell_gains_what_its_cell_does() -> None:
    task = Task(4, cost=0.1, t_max=0)
    view = SensorsInView(task, Window(task, 1))
    gain, on = torch.rand(16, 1, 9), torch.ones(16, 1, 9, dtype=torch.bool)
    assert view.gains(gain, on, slice(None)) is gain
    assert view.seen(on, slice(None)) is on
    assert torch.equal(view.numbers, Window(task, 1).cells)
