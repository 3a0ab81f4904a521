"""Outcome of a step, batched: whether the target is located, and the pseudo-reward (paper, eq. reward_func)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from trackmdp.arrays.types import Array
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window


class Costs:
    """Prices of sets of sensors, on one device.

    Args:
        task: the prices, and which sensors can be chosen.
        device: device of the tensors.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        self.sensor = torch.as_tensor(task.paid, dtype=torch.float32, device=device)
        self._window = Window.of(task, device)
        charged, self._of_count = task.cost[task.available], None
        if (charged == charged[0]).all():
            count = torch.arange(max(task.num_sensors, task.total_sensors) + 1, device=device)
            self._of_count = count.int() * self.sensor.max()
        # Cell M, outside the grid, costs nothing.
        self._steps = torch.as_tensor(np.append(_whole_steps(task.paid), 0.0), device=device)

    def sensing_cost(self, action: Tensor, last_cell: Tensor) -> Tensor:
        """`[B]` float32 price of the sensors of `action` `[B, K]`, chosen from `last_cell` `[B]`."""
        if not self._window.is_local:
            return self.price_of(action)
        if self._of_count is not None:
            return self.price_of(action & self._window.inside(last_cell))
        price = self._steps[self._window.around(last_cell)]
        return (action * price).sum(-1).to(self.sensor.dtype)

    def of_each(self, last_cell: Tensor) -> Tensor:
        """Float32 price of each sensor, `[S]`, or in a window `[*B, K]` as seen from `last_cell` `[*B]`."""
        if not self._window.is_local:
            return self.sensor
        return self._steps[self._window.around(last_cell)].to(self.sensor.dtype)

    def price_of(self, action: Tensor) -> Tensor:
        """`[B]` float32 price of the available sensors of `action` `[B, S]`."""
        if self._of_count is not None:
            # The price of a count of bits: the same float32 for any order of the sensors. A sum of bools would
            # first convert all of them to int64.
            count = action.view(torch.uint8).sum(-1, dtype=torch.int32)
            return self._of_count.index_select(0, count)
        return (action.to(self._steps.dtype) @ self._steps[:-1]).to(self.sensor.dtype)

    def of_sets(self, sets: sparse.csr_array) -> Tensor:
        """`[R]` float32 price of each row of `sets` `[R, S]`, the same bits as of `price_of`."""
        if self._of_count is not None:
            return self._of_count[torch.as_tensor(np.diff(sets.indptr), device=self.sensor.device)]
        exact = sets.astype(np.float64) @ self._steps[:-1].cpu().numpy()
        return torch.as_tensor(exact, device=self.sensor.device).to(self.sensor.dtype)


def _whole_steps(cost: Array) -> Array:
    """`[S]` float64 prices rounded to 2^-40 of the largest: their sums are exact, in any order and batch."""
    # Prices become at most 2^40 steps each, and float64 adds integers exactly up to 2^53: 8,192 sensors of the highest
    # price.
    step = 2.0 ** (np.ceil(np.log2(max(cost.max(), 1e-300))) - 40)
    return np.round(cost / step) * step


class StepOutcome(NamedTuple):
    """Outcome of a step of B targets.

    Attributes:
        in_grid: `[B]` bool, whether the target is still in the grid after its move.
        forced: `[B]` bool, whether the safe action replaces the chosen sensors.
        located: `[B]` bool, whether the target is reported, by a sensor or by the safe action.
        missed: `[B]` bool, whether it is in the grid and not reported.
        reward: `[B]` float32.
    """

    in_grid: Tensor
    forced: Tensor
    located: Tensor
    missed: Tensor
    reward: Tensor


class Outcomes:
    """Outcomes of steps in a task, on one device.

    Args:
        task: the task.
        device: device of the tensors.

    Attributes:
        certain: whether sensors and the safe action always report, so that no draw is needed.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        self.certain = task.perfect and task.safe
        self._num_cells, self._t_max, self._safe = task.num_cells, task.t_max, task.safe
        gain, safe_cost = float(task.reward), float(task.safe_cost)
        # Rewards of a detection by a sensor, of a safe action that locates the target, and of one that misses it; and
        # none. As tensors: `torch.where` would make one of a number in each step.
        # Each with its own memory: Python 3.11 starts no process with two tensors that share one.
        rewards = (
            torch.tensor(r, device=device) for r in (gain, gain - safe_cost, -safe_cost, 0.0)
        )
        self._gain, self._found, self._lost, self._none = rewards
        self._zero = torch.zeros((), dtype=torch.int64, device=device)
        # After an exit, at cell M, nothing is reported.
        self._detection = torch.as_tensor(np.append(task.safe_detection, 0.0), device=device)

    def __call__(
        self, report: Tensor, spent: Tensor, misses: Tensor, target: Tensor, draws: Tensor | None
    ) -> StepOutcome:
        """Outcome of a step.

        Args:
            report: `[B]` probability that some sensor reports the target, see `Detection`.
            spent: `[B]` float32 price of the sensors that are on.
            misses: `[B]` n before the step; after t_max + 1 misses the safe action is forced.
            target: `[B]` cells after the move, M after an exit.
            draws: `[B]` uniform in [0, 1); None where `certain`.
        """
        in_grid, forced = target < self._num_cells, misses > self._t_max
        if draws is None:
            located = (report | forced) & in_grid
        else:
            safe = self._detection.index_select(0, target)
            located = (draws < torch.where(forced, safe, report)) & in_grid
        reward = self.reward(spent, located, forced, in_grid)
        return StepOutcome(in_grid, forced, located, in_grid ^ located, reward)

    def reward(self, spent: Tensor, located: Tensor, forced: Tensor, in_grid: Tensor) -> Tensor:
        """`[B]` r·1[located] - c·|a|, where forced r·1[located] - D; 0 on the exit step."""
        # Costs are zeroed on the exit step together with the reward (eq. reward_func multiplies all of it).
        safe = self._found if self._safe else torch.where(located, self._found, self._lost)
        chosen = torch.where(located, self._gain, self._none) - spent
        return torch.where(forced, safe, chosen).masked_fill_(~in_grid, 0.0)

    def misses_after(self, misses: Tensor, outcome: StepOutcome) -> Tensor:
        """`[B]` n after the step: one more where missed, 0 else; the clock stands still if the safe action misses."""
        more = misses + 1
        if not self._safe:
            more = more.clamp_max_(self._t_max + 1)
        return torch.where(outcome.missed, more, self._zero)
