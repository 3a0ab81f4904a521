"""Detection: the probability that some sensor that is on reports the target. All of the environment asks it here.

Sensors report independently: of the sensors that are on, at least one reports a target in cell j with probability
1 - prod (1 - p(s, j)). Sensors that each cover the cell of their own number (the paper's, and with misses)
take one look-up; footprints are a sparse matrix `[S, M]` of p(s, j).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from trackmdp.arrays.entries import padded_rows
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


class Detection:
    """Probability of a report for batches of actions, on one device.

    Args:
        task: its sensors.
        device: device of the tables.
        everywhere: actions are over all sensors, also where the task has a window.

    Attributes:
        perfect: whether every sensor that is on reports a target that it covers.
    """

    def __init__(
        self, task: Task, device: torch.device | str = "cpu", *, everywhere: bool = False
    ) -> None:
        self.perfect = task.perfect
        self._window = Window(task, None if everywhere else task.numbered, device)
        self._covering: Tensor | None = None
        if task.coverage is not None:
            # [M + 1, d] sensors that cover each cell, padded with S, and the probabilities that they miss: three cells
            # covered by sensors 0, by 0 and 1, and by none of two give, with the exit, 0 2, 0 1, 2 2, 2 2.
            sensors, chance = padded_rows(task.sees_by_cell, task.total_sensors, more=1)
            self._covering = torch.as_tensor(sensors, device=device)
            self._misses = torch.as_tensor(1.0 - chance, device=device)
        elif not self.perfect:
            # Cell M, where a target is after its exit, is seen by no sensor.
            self._detection = torch.as_tensor(np.append(task.detection, 0.0), device=device)

    def __call__(self, action: Tensor, last: Tensor, target: Tensor) -> Tensor:
        """`[B]`, or `[B, T]` of T targets each, float64 probability of a report; bool where all sensors are perfect.

        Args:
            action: `[B, K]` bool, chosen from `last`.
            last: `[B]` last located cells; of no meaning for actions over all sensors.
            target: `[B]` or `[B, T]` cells of the targets; M after an exit, where the answer is of no meaning.
        """
        if self._covering is not None:
            sensors = self._covering[target]
            # Number S, the padding, is a sensor that is never on.
            on = nn.functional.pad(action, (0, 1)).gather(1, sensors.flatten(1)).view_as(sensors)
            if self.perfect:
                return on.any(-1)
            return 1.0 - torch.where(on, self._misses[target], 1.0).prod(-1)
        sensor = self._window.find(last, target)
        # A number of at least K is no sensor: its target is outside the window or, clamped to a valid one, after its
        # exit.
        place = sensor.clamp_max(action.shape[1] - 1).view(len(action), -1)
        on = action.gather(1, place).view_as(sensor)
        if self._window.is_local:
            on = on & (sensor < action.shape[1])
        return self.of_cell(on, target)

    def of_cell(self, covered: Tensor, cell: Tensor) -> Tensor:
        """As a call, for targets in `cell`, of the bool or probability that a sensor there is on."""
        if self.perfect or self._covering is not None:
            return covered
        return covered * self._detection.take(cell)
