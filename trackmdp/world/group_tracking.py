"""A batch of groups of targets: state, generators, steps and resets, without TorchRL's interface."""

from __future__ import annotations

import torch
from torch import Tensor

from trackmdp.world.draws import UniformDraws
from trackmdp.world.dynamics import State, rowwise
from trackmdp.world.group import Group
from trackmdp.world.outcomes import Costs
from trackmdp.world.paths import PathSampler
from trackmdp.world.targets import Targets
from trackmdp.world.tracking import TargetBatch


class _Members(Targets):
    """Targets of all groups in a row, each in a cell of its own motion at the start.

    Args:
        group: the targets.
        count: B, groups.
        device: of the draws.
    """

    def __init__(self, group: Group, count: int, device: torch.device) -> None:
        super().__init__(PathSampler(group.kernel, device=device))
        cells, kind = group.task.num_cells, torch.as_tensor(group.kind, device=device)
        self._cells, self._offset = cells, (kind * cells).repeat(count)

    def _start(self, rows: Tensor) -> Tensor:
        rng = self.generators["start"]
        cell = torch.randint(self._cells, rows.shape, generator=rng, device=self.device)
        return cell + self._offset


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
        self._targets = _Members(group, count, device)
        self._states, self._cells = group.kernel.shape[0], task.num_cells
        self._reports = UniformDraws(device, None if task.perfect else "report")
        self._every = torch.ones(count * self.targets, dtype=torch.bool, device=device)
        self._costs, self._t_max = Costs(task, device), task.t_max
        self._reward, self._safe = task.reward, task.safe_cost
        self._history = (count, task.num_choices, task.total_sensors)
        self._detection = torch.as_tensor(task.detection, device=device)
        self._available = torch.as_tensor(task.available, device=device)
        self.masked = not task.available.all()
        self.state = {}

    def restart(self) -> None:
        """New episodes in all rows."""
        self.state = self._fresh(self._targets.start(self._every))

    def begin(self, done: Tensor) -> None:
        """New episodes in the rows of a mask `[B, 1]`."""
        if torch.compiler.is_compiling() or done.any():
            rows, fresh = done.squeeze(-1), self._fresh(self._targets.start(self._every))
            self.state = {key: rowwise(rows, fresh[key], each) for key, each in self.state.items()}

    def _fresh(self, place: Tensor) -> State:
        """Initial states of targets in `place` `[B K]`, which are located."""
        place = place.view(self.count, self.targets)
        state = {
            "place": place,
            "last_cell": place % self._cells,
            "steps_since_detection": torch.zeros_like(place),
            "present": torch.ones_like(place, dtype=torch.bool),
            "action_history": torch.zeros(self._history, dtype=torch.bool, device=self.device),
        }
        if self.masked:
            state["action_mask"] = self._available.expand(self.count, -1)
        return state

    def step(self, action: Tensor) -> State:
        """One step with the sensors of `action` `[B, S]` bool on; returns the state, the reward and the flags."""
        state, shape = self.state, (self.count, self.targets)
        draws, uniform = self._targets.draw(self._every), self._reports(self._every)
        place = self._targets.sampler.move(state["place"].reshape(-1), draws).view(shape)
        present, cell = place < self._states, place % self._cells
        n = state["steps_since_detection"]
        forced = (n > self._t_max).any(-1, keepdim=True)
        report = action.gather(1, cell)
        if uniform is not None:
            report = report & (uniform.view(shape) < self._detection[cell])
        seen, any_left = (report | forced) & present, present.any(-1, keepdim=True)
        spent = self._costs.price_of(action & self._available).unsqueeze(-1)
        spent = torch.where(forced, self._safe, spent) * any_left
        reward = self._reward * seen.sum(-1, keepdim=True) - spent
        # The last action comes first; after the safe action, which locates all targets, nothing is remembered.
        history = torch.cat([action.unsqueeze(1), state["action_history"][:, :-1]], 1)
        following = {
            "place": place,
            "last_cell": torch.where(seen, cell, state["last_cell"]),
            # A target that has left keeps no clock, which would force the safe action.
            "steps_since_detection": torch.where(present & ~seen, n + 1, 0),
            "present": present,
            "action_history": history & ~forced.unsqueeze(-1),
            "reward": reward.float(),
        }
        if self.masked:
            following["action_mask"] = state["action_mask"]
        self.state = {key: following[key] for key in state}
        none = torch.zeros_like(any_left)
        return following | {"done": ~any_left, "terminated": ~any_left, "truncated": none}

    def target(self) -> Tensor:
        """`[B, K]` cells of the targets, M after an exit."""
        place = self.state["place"]
        return torch.where(place < self._states, place % self._cells, self._cells)
