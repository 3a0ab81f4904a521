"""Dynamics of several targets that share the sensors, as pure functions of states, actions and draws."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from trackmdp.environment.dynamics import State
from trackmdp.environment.group_paths import GroupPaths
from trackmdp.sensing.detection import Detection
from trackmdp.sensing.outcomes import Costs
from trackmdp.sensing.task import Task


class GroupDynamics:
    """As `Dynamics`, of B groups of K targets; all that is observed of the targets is `[B, K]`.

    Args:
        task: the task.
        paths: of the targets.
        targets: K.

    Attributes:
        detection: the probability of reports.
        masked: whether some cells have no sensor, so that `action_mask` is observed.
        waits: whether targets may enter later.
    """

    def __init__(self, task: Task, paths: GroupPaths, targets: int) -> None:
        device = self._device = paths.sampler.device
        self._paths, self._targets, self.waits = paths, targets, paths.waits
        self._cells, self._max_steps, self._t_max = task.num_cells, task.max_steps, task.t_max
        self._costs, self._history = Costs(task, device), (task.num_choices, task.total_sensors)
        self._reward, self._safe = task.reward, task.safe_cost
        self.detection = Detection(task, device, everywhere=True)
        self._safe_report = torch.as_tensor(task.safe_detection, device=device)
        self._available = torch.as_tensor(task.available, device=device)
        self.masked = not task.available.all()

    def start(self, place: Tensor) -> State:
        """Initial states of targets in `place` `[B K]`; those that are in the grid are located."""
        place = place.view(-1, self._targets)
        inside, count = self._paths.inside(place), len(place)
        state = {
            "place": place,
            # Where a target will enter is nothing that a tracker knows.
            "last_cell": torch.where(inside, self._paths.cell(place), 0),
            "steps_since_detection": torch.zeros_like(place),
            "present": inside,
            "action_history": torch.zeros(
                count, *self._history, dtype=torch.bool, device=self._device
            ),
        }
        if self._max_steps:
            state["step_count"] = place.new_zeros(count)
        if self.masked:
            state["action_mask"] = self._available.expand(count, -1)
        return state

    def cell(self, state: Mapping[str, Tensor]) -> Tensor:
        """`[B, K]` cells of the targets, M where they are not in the grid."""
        place = state["place"]
        return torch.where(self._paths.inside(place), self._paths.cell(place), self._cells)

    def advance(
        self, state: Mapping[str, Tensor], action: Tensor, draws: Tensor, reports: Tensor | None
    ) -> State:
        """State, reward and flags after one step, as of `Dynamics`; `draws` and `reports` are `[B K]`."""
        shape = state["place"].shape
        place = self._paths.move(state["place"], draws.view(shape))
        inside, cell = self._paths.inside(place), self._paths.cell(place)
        # A target that enters is located, and counts from the next step on, as the start of an episode is no step.
        present, n = inside & state["present"], state["steps_since_detection"]
        forced = (n > self._t_max).any(-1, keepdim=True)
        on = action & self._available
        report = self.detection(on, cell, cell)
        if reports is None:
            report = report | forced
        else:
            report = reports.view(shape) < torch.where(forced, self._safe_report[cell], report)
        seen, any_left = report & present, present.any(-1, keepdim=True)
        spent = self._costs.price_of(on).unsqueeze(-1)
        spent = torch.where(forced, self._safe, spent) * any_left
        reward = self._reward * seen.sum(-1, keepdim=True) - spent
        # The last action comes first; after the safe action nothing is remembered.
        history = torch.cat([on.unsqueeze(1), state["action_history"][:, :-1]], 1)
        seen, more = seen | (inside ^ present), (n + 1).clamp_max(self._t_max + 1)
        following = {
            "place": place,
            "last_cell": torch.where(seen, cell, state["last_cell"]),
            # A target that has left keeps no clock, which would force the safe action. If that misses, it is repeated.
            "steps_since_detection": torch.where(inside & ~seen, more, 0),
            "present": inside,
            "action_history": history & ~forced.unsqueeze(-1),
            "reward": reward.float(),
        }
        done = self._paths.ended(place).unsqueeze(-1)
        if self._max_steps:
            following["step_count"] = state["step_count"] + 1
            done = done | (following["step_count"] >= self._max_steps).unsqueeze(-1)
        if self.masked:
            following["action_mask"] = state["action_mask"]
        # The exit of the last target counts, also on the last step allowed.
        flags = {"done": done, "terminated": done & ~any_left, "truncated": done & any_left}
        return following | flags
