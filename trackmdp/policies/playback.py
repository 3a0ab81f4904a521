"""The actions of a recorded episode, issued again whatever is observed."""

from __future__ import annotations

import torch
from torch import Tensor

from trackmdp.errors import UserError
from trackmdp.world.model import BoolArray, Task


class Playback:
    """An open-loop policy: the action depends on the step of the episode alone.

    It is therefore no table, and has no exact value; it can be simulated. After the last recorded action no sensor is
    on, and the safe action locates the target.

    Args:
        task: grid, costs and limits.
        actions: `[T, S]` bool, in their order.

    Raises:
        UserError: the actions are those of another grid.
    """

    def __init__(self, task: Task, actions: BoolArray) -> None:
        if actions.shape[1:] != (task.total_sensors,):
            raise UserError(f"playback: actions of {actions.shape[1:]} sensors, expected {task.total_sensors}")
        self.task = task
        self.actions = torch.as_tensor(actions, dtype=torch.bool)

    def at(self, step: int) -> Tensor:
        """`[S]` bool, the action of a step."""
        return self.actions[step] if step < len(self.actions) else torch.zeros_like(self.actions[0])
