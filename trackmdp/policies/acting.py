"""What acts without being a finished policy: while frames are collected, in benchmarks, or as an episode is recorded.

A table replaced during learning, one that at random senses everything, random subsets, and the actions of a recorded
episode, issued again whatever is observed.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from trackmdp.errors import UserError
from trackmdp.policies.lookup import in_window
from trackmdp.policies.table import PolicyTable
from trackmdp.world.model import BoolArray, Task

_ROWS_AT_ONCE = 2**12


class RandomSubset(TensorDictModuleBase):
    """Each sensor on with probability 1/2, from its own generator; what benchmarks drive the environment with."""

    in_keys: ClassVar = ["last_cell"]
    out_keys: ClassVar = ["action"]

    def __init__(self, num_cells: int, generator: torch.Generator) -> None:
        super().__init__()
        self.num_cells, self.generator = num_cells, generator
        self._shifts = nn.Buffer(torch.arange(63, device=generator.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[B, M]`: the bits of random 63-bit words."""
        shape, m = tensordict["last_cell"].shape, self.num_cells
        # 63 bits a word: `random_` fills int64 from 0 to 2^63 - 1, so that the sign bit is never set.
        words = torch.empty(*shape, -(-m // 63), dtype=torch.int64, device=self.generator.device)
        words.random_(generator=self.generator)
        bits = (words.unsqueeze(-1) >> self._shifts) & 1
        return tensordict.set("action", bits.flatten(-2)[..., :m].bool())


class RenewedTable(TensorDictModuleBase):
    """Acts as a deterministic policy that is replaced from time to time.

    The table is a buffer of fixed shape, for collectors hand buffers on to their worker processes; so it holds a bit
    for every entry and not the entries stored, which change in number. There are M (t_max+1) K entries, with keys in
    place of the M cells where there are any, in the local numbers of the window where the task has one.

    Args:
        task: what it acts in.
        device: where it acts.
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
        # numpy.packbits puts the first of eight entries into the highest bit.
        self._place = nn.Buffer(torch.arange(7, -1, -1, device=device), persistent=False)

    def renew(self, policy: PolicyTable) -> None:
        """Act as the deterministic `policy` from now on."""
        sets = in_window(self.task, policy.sets)
        for begin in range(0, len(self.bits), _ROWS_AT_ONCE):
            rows = sets[begin : begin + _ROWS_AT_ONCE].toarray()
            self.bits[begin : begin + len(rows)].copy_(torch.as_tensor(np.packbits(rows, axis=1)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`, local to `last_cell` where the task has a window."""
        key, n = (tensordict[name] for name in self.in_keys)
        # n = t_max + 1 has no row of its own: the safe action replaces whatever is written there.
        packed = self.bits[key * self.task.num_choices + n.clamp_max(self.task.t_max)]
        # [*B, bytes, 1] >> [8] = [*B, bytes, 8], flattened to bits in the order of the sensors; the padding is cut off.
        chosen = ((packed.unsqueeze(-1) >> self._place) & 1).flatten(-2)[..., : self.task.num_sensors].bool()
        return tensordict.set("action", chosen)


class Exploring(RenewedTable):
    """Every sensor on with probability `explore` where the target is located, else the table.

    The coin is tossed before the target moves, so that what is seen on the steps with all sensors on is what all steps
    from there are like, however the table chooses.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        super().__init__(task, device)
        self.explore = nn.Buffer(torch.ones((), device=device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write `action` `[*B, K]`."""
        n = tensordict["steps_since_detection"]
        # Only at n = 0: after a miss the cell before the move is not known, and the step would show no move.
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
