"""Whether the sensors that are on see the target: the one of its cell, or any whose footprint it is in; batched."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trackmdp.world.model import Task
from trackmdp.world.windows import Window


class Sight:
    """What a task's sensors see, on one device.

    Args:
        task: its sensors.
        device: where the tensors live.
        everywhere: actions are over all sensors, also where the task has a window.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu", *, everywhere: bool = False) -> None:
        self._window = Window(task, None if everywhere else task.window, device)
        self._covering: Tensor | None = None
        if task.coverage is None:
            return
        # [M + 1, d], the sensors that cover each cell, filled up with S, which there is none of; nothing covers M, the
        # place of a target that has exited. Three cells covered by sensors 0, 0 1 and none of two, and M: 0 2, 0 1,
        # 2 2, 2 2.
        table, degree = task.coverage.by_cell, torch.as_tensor(task.coverage.degree)
        covering = torch.full((task.num_cells + 1, int(degree.max())), task.coverage.num_sensors)
        covering[:-1][torch.arange(covering.shape[1]) < degree.unsqueeze(1)] = torch.as_tensor(table.indices).long()
        self._covering = covering.to(device)

    def sees(self, action: Tensor, last: Tensor, target: Tensor) -> Tensor:
        """`[B]` bool, whether `action` `[B, K]`, chosen from `last` `[B]`, senses `target` `[B]`; never at M."""
        if self._covering is not None:
            return nn.functional.pad(action, (0, 1)).gather(1, self._covering[target]).any(-1)
        # The sensor that could see the target: K, none, where it has exited or left the window.
        sensor, width = self._window.find(last, target), action.shape[1]
        # Indexing needs a valid number, so K is clamped to K - 1, and what was read there is discarded by the
        # comparison.
        return action.gather(1, sensor.clamp_max(width - 1).unsqueeze(1)).squeeze(1) & (sensor < width)
