"""Behaviour policies: modules that act while frames are collected, or as an episode is played back.

A table that is replaced during learning, one that at random senses everything, and a recorded sequence of actions.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from trackmdp.arrays.types import BoolArray
from trackmdp.errors import UserError
from trackmdp.policies.lookup import in_window
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task

_ROWS_AT_ONCE = 2**12


class RenewedTable(TensorDictModuleBase):
    """Acts as a deterministic policy that is replaced from time to time.

    The table is a buffer of fixed shape, because collectors copy buffers to their worker processes; it therefore holds
    a bit for every entry: the number of entries stored would change. There are keys · (t_max+1) · K entries, in
    the local numbers of the window where the task has one.

    Args:
        task: the task it acts in.
        device: device of the table.
        on: whether all sensors are on at first, or none.
    """

    out_keys: ClassVar = ["action"]

    def __init__(self, task: Task, device: torch.device | str = "cpu", *, on: bool = False) -> None:
        super().__init__()
        self.task = task.task
        self.in_keys = ["key" if task.keyed else "last_cell", "steps_since_detection"]
        # Row key (t_max + 1) + n, as in `PolicyTable`; 8 sensors per byte: 10 x 10 cells take 13 bytes a row.
        shape = (task.num_keys * task.num_choices, -(-task.num_sensors // 8))
        self.bits = nn.Buffer(torch.full(shape, 255 * on, dtype=torch.uint8, device=device))
        # The eight bools of each byte, the highest bit first as in `numpy.packbits`, are read as one int64: one look-up
        # a byte instead of a shift and a mask a bit.
        each = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).view(np.int64)
        self._words = nn.Buffer(torch.as_tensor(each[:, 0], device=device), persistent=False)

    def renew(self, policy: PolicyTable) -> None:
        """Act as the deterministic `policy` from now on."""
        sets = in_window(self.task, policy.written)
        for begin in range(0, len(self.bits), _ROWS_AT_ONCE):
            rows = sets[begin : begin + _ROWS_AT_ONCE].toarray()
            self.bits[begin : begin + len(rows)].copy_(torch.as_tensor(np.packbits(rows, axis=1)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`, local to `last_cell` where the task has a window."""
        key, n = (tensordict[name] for name in self.in_keys)
        # n = t_max + 1 has no row of its own: the safe action replaces any action there.
        packed = self.bits[key * self.task.num_choices + n.clamp_max(self.task.t_max)]
        # Indices are int32 or int64; bytes would be a mask.
        bools = self._words.index_select(0, packed.reshape(-1).int()).view(torch.bool)
        action = bools.view(*packed.shape[:-1], -1)[..., : self.task.num_sensors]
        return tensordict.set("action", action)


class Exploring(RenewedTable):
    """Every sensor on with probability `explore` where the target is located, else the table.

    The decision to explore precedes the target's move: the fully sensed moves are then an unbiased sample of the
    motion, for any table.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        super().__init__(task, device)
        self.explore = nn.Buffer(torch.ones((), device=device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`."""
        n = tensordict["steps_since_detection"]
        # Only at n = 0: after a miss the cell before the move is unknown, and the step would show no move.
        everything = (torch.rand(n.shape, device=n.device) < self.explore) & (n == 0)
        action = super().forward(tensordict)["action"]
        return tensordict.set("action", action | everything.unsqueeze(-1))


class Playback:
    """An open-loop policy: the action depends on the step of the episode alone.

    It is therefore no table, and has no exact value; it can be simulated. After the last recorded action no sensor is
    on, and the safe action locates the target.

    Args:
        task: grid, costs and limits.
        actions: `[T, S]` bool, in their order.

    Raises:
        UserError: the actions are those of another grid, or exceed the budget.
    """

    def __init__(self, task: Task, actions: BoolArray) -> None:
        if actions.shape[1:] != (task.total_sensors,):
            raise UserError(
                f"playback: actions of {actions.shape[1:]} sensors, expected {task.total_sensors}"
            )
        if task.budget is not None and (most := actions.sum(axis=1).max(initial=0)) > task.budget:
            raise UserError(f"playback: {most} sensors on in a step; expected {task.budget}")
        self.task = task
        self.actions = torch.as_tensor(actions, dtype=torch.bool)

    def at(self, step: int) -> Tensor:
        """`[S]` bool, the action of a step."""
        return self.actions[step] if step < len(self.actions) else torch.zeros_like(self.actions[0])
