"""What sensors with footprints gain given those that are on, against the definition."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from trackmdp.algos.in_view import SensorsInView
from trackmdp.sensing.coverage import discs
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

LINE = Task((1, 4), cost=0.1, t_max=0, coverage=[[1, 1, 1, 0], [0, 0, 1, 1]])


def test_sensors_of_a_line_by_hand() -> None:
    """Windows (-, 0, 1), (0, 1, 2), (1, 2, 3), (2, 3, -); from the first, sensor 0 alone can see the target."""
    view = SensorsInView(LINE, Window(LINE, 1))
    assert view.numbers.tolist() == [[0, 2], [0, 1], [0, 1], [0, 1]]
    gain, on = torch.zeros(4, 1, 9), torch.tensor([[[True, False]], [[True, True]]] * 2)
    gain[..., 3:6] = torch.tensor([1.0, 2.0, 4.0])  # the rows above and below lie outside
    # From cell 0 sensor 0 sees 2 + 4. From 1 it alone sees 1 + 2, both see 4; from 2, where it is on, 1 + 2, and the
    # other one 4 more; from 3, with both on, both see 1, and 2 is seen by sensor 1 alone.
    assert view.gains(gain, on, slice(None)).flatten().tolist() == pytest.approx(
        [6, 0, 3, 0, 3, 4, 0, 2], abs=1e-5
    )
    assert view.reports(on[1:3], slice(1, 3))[:, 0, 3:6].tolist() == [
        [True, True, True],
        [True, True, False],
    ]


@pytest.mark.parametrize("radius", [None, 1])
@pytest.mark.parametrize("draws", [False, True])
def test_gains_are_what_a_set_is_worth_more(radius: int | None, draws: bool) -> None:
    places = np.array([(0, 0), (0, 1), (1, 2), (2, 2), (3, 0), (3, 3)])
    task = Task(4, cost=0.1, t_max=0, coverage=discs((4, 4), places, 1.5))
    window = Window(task, radius)
    view, rng = SensorsInView(task, window), torch.Generator().manual_seed(0)
    gain = torch.randn(16, 1, window.width, generator=rng)
    on = torch.rand(16, 1, view.width, generator=rng)
    on = on if draws else on < 0.4
    found = view.gains(gain, on, slice(None))
    for x in range(16):
        cells = {int(c): float(gain[x, 0, i]) for i, c in enumerate(window.cells[x]) if c < 16}
        chances = {
            int(s): float(p) for s, p in zip(view.numbers[x], on[x, 0], strict=True) if s < 6
        }
        assert set(chances) == {
            s for s in range(6) if task.covered(np.eye(6, dtype=bool))[s, list(cells)].any()
        }
        for place, sensor in enumerate(view.numbers[x].tolist()):
            more = _worth(task, cells, chances | {sensor: 1.0}) - _worth(
                task, cells, chances | {sensor: 0.0}
            )
            assert float(found[x, 0, place]) == pytest.approx(
                0.0 if sensor == 6 else more, abs=1e-5
            )


def _worth(task: Task, cells: dict[int, float], chances: dict[int, float]) -> float:
    """The expected sum of the `cells` that sensors see, over all sets of them."""
    covers, total = (
        task.covered(np.eye(task.total_sensors + 1, task.total_sensors, dtype=bool)),
        0.0,
    )
    for chosen in itertools.product([False, True], repeat=len(chances)):
        likely = np.prod(
            [p if yes else 1 - p for p, yes in zip(chances.values(), chosen, strict=True)]
        )
        sensors = list(itertools.compress(chances, chosen))
        total += float(likely) * sum(
            each for cell, each in cells.items() if covers[sensors, cell].any()
        )
    return total


def test_a_sensor_in_each_cell_gains_what_its_cell_does() -> None:
    task = Task(4, cost=0.1, t_max=0)
    view = SensorsInView(task, Window(task, 1))
    gain, on = torch.rand(16, 1, 9), torch.ones(16, 1, 9, dtype=torch.bool)
    assert view.gains(gain, on, slice(None)) is gain
    assert view.reports(on, slice(None)) is on
    assert torch.equal(view.numbers, Window(task, 1).cells)
