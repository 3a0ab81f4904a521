"""A batch of tracked targets in a row: state, generators, steps and resets, without TorchRL's interface."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from trackmdp.environment.dynamics import Dynamics, State, rowwise
from trackmdp.environment.group_dynamics import GroupDynamics
from trackmdp.environment.group_paths import GroupPaths, group_members
from trackmdp.environment.paths import path_sampler
from trackmdp.environment.targets import RecordedTargets, Targets
from trackmdp.sensing.task import Task
from trackmdp.world.group import Group
from trackmdp.world.problem import Problem

Snapshot = Mapping[str, Mapping[str, Tensor]]


class Tracking:
    """State of B targets `[B, ...]`, or of B groups, and the generators of their draws.

    Args:
        problem: a world, recorded tracks, or a group.
        count: B.
        device: device of the tensors.

    Attributes:
        device: of the tensors.
        dynamics: initial states and steps as pure functions.
        each: targets of a row.
        state: of all targets, empty before the first restart. Its tensors are replaced, never written to, as they are
            those observed.
    """

    dynamics: Dynamics | GroupDynamics

    def __init__(self, problem: Problem | Group, count: int, device: torch.device) -> None:
        task: Task = problem.task if isinstance(problem, Group) else problem
        self.device, self.each = device, len(problem.targets) or 1
        self._t_max, self._cells = task.t_max, torch.arange(task.num_cells, device=device)
        missed = not (task.perfect and task.safe)
        if isinstance(problem, Group):
            paths = GroupPaths(problem, device)
            self._targets = group_members(paths, count, missed)
            self.dynamics = GroupDynamics(task, paths, self.each)
        else:
            kind = Targets if problem.recorded is None else RecordedTargets
            self._targets = kind(path_sampler(problem, device), missed)
            self.dynamics = Dynamics(problem, self._targets.sampler)
        self._every = torch.ones(count * self.each, dtype=torch.bool, device=device)
        self.state: State = {}
        # Of the last step: the action, the last located cells and the misses before it; and masks `[B, 1]` of the rows
        # begun anew since.
        self._acted: tuple[Tensor, Tensor, Tensor] | None = None
        self._begun: list[Tensor] = []

    def seed(self, seed: int, stream: str) -> None:
        """Start the generators anew; their names begin with `stream`."""
        self._targets.seed(seed, stream)

    def snapshot(self) -> dict[str, dict[str, Tensor]]:
        """The state, and the states of the generators."""
        return {"rows": dict(self.state), "generators": self._targets.state()}

    def load(self, snapshot: Snapshot) -> None:
        """Continue from a `snapshot`.

        Raises:
            AttributeError, LookupError, RuntimeError, TypeError, ValueError: it is none of such targets; all stays.
        """
        rows = {key: value.to(self.device) for key, value in snapshot["rows"].items()}
        self._check(rows)
        before = self._targets.state()
        try:
            self._targets.load_state(snapshot["generators"])
        except BaseException:
            self._targets.load_state(before)
            raise
        self.state, self._acted = rows, None

    def _check(self, rows: State) -> None:
        """Raise a ValueError unless `rows` have the form of a state and the targets are in places that exist."""
        expected = self.dynamics.start(torch.zeros_like(self._every, dtype=torch.int64))
        forms = {key: (value.shape, value.dtype) for key, value in expected.items()}
        if {key: (value.shape, value.dtype) for key, value in rows.items()} != forms:
            raise ValueError("other tensors")
        place = rows["place"]
        # The places of targets that are still to enter are negative.
        exists = (place >= 0) | self.dynamics.waits
        if not (exists & (place <= self._targets.sampler.num_states)).all():
            raise ValueError("no place of a target")

    def restart(self) -> None:
        """New episodes in all rows."""
        self.state, self._acted = self.dynamics.start(self._targets.start(self._every)), None

    def begin(self, done: Tensor) -> None:
        """New episodes in the rows of a mask `[B, 1]`."""
        self._begun.append(done)
        state, rows = self.state, done.squeeze(-1)
        begun = rows if self.each == 1 else done.expand(-1, self.each).reshape(-1)
        if torch.compiler.is_compiling() or self.device.type != "cpu":
            # No shape and no branch may depend on the number of rows.
            fresh = self.dynamics.start(self._targets.start(begun))
            self.state = {key: rowwise(rows, fresh[key], value) for key, value in state.items()}
        elif (at := done.nonzero()).numel():
            at, starts = at[:, 0], self._targets.start(begun).view(len(done), -1)
            fresh = self.dynamics.start(starts.index_select(0, at).view(-1))
            # Empty already of one target whose episode did not end in a miss; the history is the largest part by far.
            missed = "present" in state or state["steps_since_detection"].index_select(0, at).any()
            same = () if missed else ("steps_since_detection", "action_history")
            self.state = {
                key: value if key in same else value.index_copy(0, at, fresh[key])
                for key, value in state.items()
            }

    def step(self, action: Tensor) -> State:
        """One step with the sensors of `action` `[B, S]` bool on; returns the state, the reward and the flags."""
        state = self.state
        draws, reports = self._targets.draw(self._every), self._targets.reports(self._every)
        following = self.dynamics.advance(state, action, draws, reports)
        self._acted = action, state["last_cell"], state["steps_since_detection"]
        self._begun = []
        self.state = {key: following[key] for key in state}
        return following

    def target(self) -> Tensor:
        """`[B]` or `[B, K]` cells of the targets, M where they are not in the grid."""
        return self.dynamics.cell(self.state)

    def covered(self, row: int) -> Tensor:
        """`[M]` bool, the cells that the sensors of a row's last step cover; none where an episode has just begun."""
        if self._acted is None or any(done[row] for done in self._begun):
            return self._cells < 0
        action, last, misses = (each[row] for each in self._acted)
        if (misses > self._t_max).any():
            return self._cells >= 0
        # Of several targets any cell will do, as there is no window.
        last = last.view(-1)[:1].expand(len(self._cells))
        action = action.expand(len(self._cells), -1)
        return self.dynamics.detection(action, last, self._cells) > 0
