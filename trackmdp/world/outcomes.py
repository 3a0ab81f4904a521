"""What comes of a step, batched: whether the target is reported, and the pseudo-reward (paper, eq. reward_func)."""

from __future__ import annotations

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.world.draws import Draw, Streams
from trackmdp.world.model import Array, Task
from trackmdp.world.windows import Window


class Costs:
    """The reward of a step from r, c and D, on one device.

    Args:
        task: the prices, and which sensors can be chosen.
        device: where the tensors live.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        self.reward, self.safe_cost = float(task.reward), float(task.safe_cost)
        self.sensor = torch.as_tensor(task.cost, dtype=torch.float32, device=device)
        self._window, self._safe = Window.of(task, device), task.safe
        self._uniform = bool((self.sensor == self.sensor[0]).all())
        # What lies outside the grid, cell M, costs nothing.
        self._steps = torch.as_tensor(np.append(_whole_steps(task.cost), 0.0), device=device)

    def sensing_cost(self, action: Tensor, last_cell: Tensor) -> Tensor:
        """`[B]` price of the sensors in `action` `[B, K]`, seen from `last_cell` `[B]`: c·|a|, or the sum of c."""
        if self._window.is_local and self._uniform:
            # One price for all: a count of bits and one product, the same float32 whatever the order of the sensors.
            return self.price_of(action & self._window.inside(last_cell))
        if self._window.is_local:
            price = self._steps[self._window.around(last_cell)]
            return (action * price).sum(-1).to(self.sensor.dtype)
        return self.price_of(action)

    def price_of(self, action: Tensor) -> Tensor:
        """`[B]` price of the sensors switched on in `action` `[B, M]`, whichever can be chosen."""
        if self._uniform:
            return action.view(torch.uint8).sum(-1, dtype=torch.int32) * self.sensor[0]  # a bool sum converts first
        return (action.to(self._steps.dtype) @ self._steps[:-1]).to(self.sensor.dtype)

    def of_sets(self, sets: sparse.csr_array) -> Tensor:
        """`[R]` price of each row of `sets` `[R, M]`, to the bit that of `price_of` for the row written out."""
        count = torch.as_tensor(np.diff(sets.indptr), dtype=torch.int32, device=self.sensor.device)
        if self._uniform:
            return count * self.sensor[0]
        exact = sets.astype(np.float64) @ self._steps[:-1].cpu().numpy()  # whatever the order of the sum
        return torch.as_tensor(exact, device=self.sensor.device).to(self.sensor.dtype)

    def pseudo_reward(self, spent: Tensor, sensed: Tensor, forced: Tensor, in_grid: Tensor) -> Tensor:
        """`[B]` reward of one step: r·1[sensed] - c·|a|, where forced r·1[sensed] - D; 0 on the exit step.

        Args:
            spent: `[B]` price of the sensors on, c·|a|.
            sensed: `[B]` the target is reported, by its cell's sensor or, where forced, by the safe action.
            forced: `[B]` the safe action replaces the sensors.
            in_grid: `[B]` the target is still in the grid after its move.
        """
        # Costs are zeroed on the exit step together with the reward (eq. reward_func multiplies all of it).
        chosen = self.reward * sensed - spent
        safe: Tensor | float = self.reward - self.safe_cost
        if not self._safe:
            safe = torch.where(sensed, safe, -self.safe_cost)
        return torch.where(forced, safe, chosen) * in_grid


def _whole_steps(cost: Array) -> Array:
    """`[M]` float64 prices rounded to 2^-40 of the largest: their sums are exact, whatever the order and the batch."""
    # Prices become at most 2^40 steps each, and float64 adds integers exactly up to 2^53: 8,192 sensors of the highest
    # price.
    step = 2.0 ** (np.ceil(np.log2(max(cost.max(), 1e-300))) - 40)
    return np.round(cost / step) * step


class Reports(Streams):
    """The reports of a task's sensors; nothing is drawn where none of them can miss.

    Args:
        task: p_d and p_s of its cells.
        device: where the tensors live.

    Attributes:
        certain: whether every sensor and the safe action always report.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        self.certain = task.perfect and task.safe
        super().__init__(torch.device(device), *(() if self.certain else ("report",)))
        # [2, M + 1]: p_d in row 0, p_s in row 1; an exited target, at M, is never reported.
        table = np.pad(np.stack([task.detection, task.safe_detection]), ((0, 0), (0, 1)))
        self._probability = torch.as_tensor(table, device=device)
        self._draw = Draw(self._draw_of, torch.float64, self.device)

    def draw(self, rows: Tensor) -> Tensor | None:
        """`[B]` float64 uniform draws for `seen` of the targets `rows` `[B]`; None where all reports are certain."""
        return None if self.certain else self._draw(rows)

    def _draw_of(self, rows: Tensor) -> Tensor:
        return torch.rand(len(rows), dtype=torch.float64, generator=self.generators["report"], device=self.device)

    def seen(self, target: Tensor, forced: Tensor, draws: Tensor | None) -> Tensor | bool:
        """`[B]` whether a sensor at `target` `[B]`, if it is on, reports it; where `forced`, the safe action does."""
        if self.certain:
            return True
        assert draws is not None
        return draws < self._probability[forced.long(), target]
