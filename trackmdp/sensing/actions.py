"""Actions: sets of sensors as bits, and the mask of the sensors that exist and can be chosen from a located cell.

Name and form of the mask are those of TorchRL, Gymnasium and PettingZoo: True where a sensor may be chosen.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from trackmdp.errors import UserError
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


def checked_action(
    action: Tensor, shape: tuple[int, ...], source: str, budget: int | None = None
) -> Tensor:
    """An action of 0 and 1, of any dtype, as bool.

    Args:
        action: the action.
        shape: its shape.
        source: start of messages.
        budget: sensors that may be on in a step; None: all.

    Raises:
        UserError: it has another shape or other values, or more sensors on.
    """
    if action.shape != shape:
        kind = str(action.dtype).removeprefix("torch.")
        found = f"{kind} {list(action.shape)}"
        raise UserError(f"{source}: expected 0 or 1 for each sensor, {list(shape)}, got {found}")
    if action.dtype != torch.bool:
        wrong = (action != 0) & (action != 1)
        if not torch.compiler.is_compiling() and wrong.any():
            first = action[wrong][0].item()
            raise UserError(f"{source}: expected 0 or 1 for each sensor, got {first}")
        action = action == 1
    if budget is not None and not torch.compiler.is_compiling():
        most = int(action.sum(-1).max()) if action.numel() else 0
        if most > budget:
            raise UserError(f"{source}: {most} sensors on, expected at most the budget, {budget}")
    return action


def words(action: Tensor) -> Tensor:
    """A contiguous `action` `[..., K]`, a byte a bit, as int32 `[..., K / 4]`; as uint8 where 4 does not divide K."""
    return action.view(torch.uint8 if action.shape[-1] % 4 else torch.int32)


class ActionMask:
    """Masks of actions for batches of located cells, on one device.

    Args:
        task: its sensors and its window.
        device: device of the tables.
        everywhere: actions are over all sensors, also where the task has a window.

    Attributes:
        observed: whether `TrackEnv` shows the mask: some cell has no sensor, or a window limits footprints. A window
            around sensors of one cell each needs none: beyond the border are no sensors.
    """

    def __init__(
        self, task: Task, device: torch.device | str = "cpu", *, everywhere: bool = False
    ) -> None:
        footprints = task.coverage is not None and task.window is not None
        self.observed = footprints or not task.available.all()
        self._window = Window(task, None if everywhere else task.numbered, device)
        mask = np.append(task.available, False)
        if footprints:
            cells, sensors = np.indices((task.num_cells, task.total_sensors)).reshape(2, -1)
            possible = task.choosable(cells, sensors)
            assert possible is not None  # there is a window
            mask = possible
        self._table = torch.as_tensor(mask, device=device)
        if footprints:
            self._table = self._table.view(task.num_cells, -1)

    def __call__(self, last: Tensor) -> Tensor:
        """`[*B, K]` bool, the sensors that can be chosen from the located cells `last` `[*B]`."""
        if self._table.ndim == 2:
            return self._table[last]
        if self._window.is_local:
            return self._table[self._window.around(last)]
        return self._table[:-1].expand(*last.shape, -1)
