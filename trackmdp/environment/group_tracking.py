"""A batch of groups of targets: state, generators, steps and resets, without TorchRL's interface."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from trackmdp.environment.draws import UniformDraws
from trackmdp.environment.dynamics import State, rowwise
from trackmdp.environment.group_paths import group_members, group_paths
from trackmdp.environment.tracking import TargetBatch
from trackmdp.sensing.outcomes import Costs
from trackmdp.world.group import Group


class GroupTracking(TargetBatch):
    """As `Tracking`, of B groups of K targets; all that is observed of the targets is `[B, K]`.

    Args:
        group: the targets.
        count: B.
        device: device of the tensors.

    Attributes:
        state: of all groups; empty before the first `restart`.
        masked: whether some cells have no sensor, so that `action_mask` is observed.
    """

    def __init__(self, group: Group, count: int, device: torch.device) -> None:
        task = group.task
        self.count, self.device, self.targets = count, device, len(group)
        self._paths = group_paths(group, device)
        self._targets = group_members(self._paths, count)
        self._cells, self._max_steps = task.num_cells, task.max_steps
        self._reports = UniformDraws(device, None if task.perfect and task.safe else "report")
        self._every = torch.ones(count * self.targets, dtype=torch.bool, device=device)
        self._costs, self._t_max = Costs(task, device), task.t_max
        self._reward, self._safe = task.reward, task.safe_cost
        self._history = (count, task.num_choices, task.total_sensors)
        # Of the sensors, and of the safe action.
        chances = np.stack([task.detection, task.safe_detection])
        self._detection = torch.as_tensor(chances, device=device)
        self._available = torch.as_tensor(task.available, device=device)
        self.masked = not task.available.all()
        self.state = {}

    def restart(self) -> None:
        """New episodes in all rows."""
        self.state = self._fresh(self._targets.start(self._every))

    def begin(self, done: Tensor) -> None:
        """New episodes in the rows of a mask `[B, 1]`."""
        if torch.compiler.is_compiling() or done.any():
            begun = done.expand(-1, self.targets).reshape(-1)
            rows, fresh = done.squeeze(-1), self._fresh(self._targets.start(begun))
            self.state = {key: rowwise(rows, fresh[key], each) for key, each in self.state.items()}

    def _fresh(self, place: Tensor) -> State:
        """Initial states of targets in `place` `[B K]`, which are located."""
        place = place.view(self.count, self.targets)
        inside = self._paths.inside(place)
        state = {
            "place": place,
            # Where a target will enter is nothing that a tracker knows.
            "last_cell": torch.where(inside, self._paths.cell(place), 0),
            "steps_since_detection": torch.zeros_like(place),
            "present": inside,
            "action_history": torch.zeros(self._history, dtype=torch.bool, device=self.device),
        }
        if self._max_steps:
            state["step_count"] = place.new_zeros(self.count)
        if self.masked:
            state["action_mask"] = self._available.expand(self.count, -1)
        return state

    def step(self, action: Tensor) -> State:
        """One step with the sensors of `action` `[B, S]` bool on; returns the state, the reward and the flags."""
        state, shape = self.state, (self.count, self.targets)
        draws, uniform = self._targets.draw(self._every), self._reports(self._every)
        place = self._paths.move(state["place"], draws.view(shape))
        inside, cell = self._paths.inside(place), self._paths.cell(place)
        # A target that enters is located, and counts from the next step on, as the start of an episode is no step.
        present, n = inside & state["present"], state["steps_since_detection"]
        forced = (n > self._t_max).any(-1, keepdim=True)
        on = action & self._available
        report = on.gather(1, cell) | forced
        if uniform is not None:
            report = report & (uniform.view(shape) < self._detection[forced.long(), cell])
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
        self.state = {key: following[key] for key in state}
        # The exit of the last target counts, also on the last step allowed.
        flags = {"done": done, "terminated": done & ~any_left, "truncated": done & any_left}
        return following | flags

    def target(self) -> Tensor:
        """`[B, K]` cells of the targets, M where they are not in the grid."""
        place = self.state["place"]
        return torch.where(self._paths.inside(place), self._paths.cell(place), self._cells)

    def _check(self, rows: State) -> None:
        """See `TargetBatch`; on tracks, targets that are still to enter are no error."""
        place = rows["place"]
        super()._check(rows | {"place": place.clamp_min(0) if self._paths.waits else place})
