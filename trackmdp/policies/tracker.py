"""A policy at work on one target: the sensors to switch on now, given the reports so far; plain numbers, no tensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np

from trackmdp.arrays.numbers import whole_number
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.errors import UserError
from trackmdp.policies.belief import BeliefFilter, Reports
from trackmdp.policies.following import Following, probabilities
from trackmdp.policies.onnx_table import OnnxTable
from trackmdp.policies.saved import load_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task

_NUMBERS = ("key", "misses", "steps", "seed")

Plan: TypeAlias = PolicyTable | OnnxTable
"""A policy for a tracker: a `Policy` or its table, or one in an ONNX file."""


class Tracker(Following):
    """Follows one target with a policy, and keeps the misses, the memory and the safe action as `TrackEnv` does.

    A step: `sensors()` are switched on, the target moves, and one of `report(cell)`, `report(None)` or `exited()`
    follows. After t_max + 1 misses in a row the safe action is due: all sensors are on. Where it reports nothing it is
    due again. The limit `max_steps` of a task is one of simulation, and is not counted here.

    Args:
        policy: the policy or its table, or a file: a `policy.npz`, or a `policy.onnx`, which onnxruntime runs. Neither
            file needs torch.
        cell: in which the target was located.
        at: its position in place of a cell: (lat, lon) or (x, y), where the place of the grid is known (`Task.place`).
        mode: of the target there, where a detection gives it (`kernel.reveals`).
        seed: of the draws of a policy that draws its sets; unused by the others.
        world: with the motion of the target, for `belief()`; None: not known.

    Attributes:
        key: the memory left by the last detection (`trackmdp.memory.keys`); the cell, where that is all.
        misses: since the last detection, n; at most t_max + 1.
        steps: reports so far.
        seed: of the draws.

    Raises:
        UserError: the cell or position is outside the grid; the mode is missing, or given where detections do not
            reveal it; the file holds no policy; the policy exceeds its budget; or the world is of another grid, t_max,
            or number of modes, or of other sensors.

    Example:
        >>> from trackmdp import Policy, make_world
        >>> tracker = Policy.none(make_world(size=3, t_max=0)).tracker(3)
        >>> tracker.sensors()
        []
        >>> tracker.report(None)
        >>> tracker.safe, tracker.sensors()
        (True, [0, 1, 2, 3, 4, 5, 6, 7, 8])
        >>> tracker.report(1)
        >>> tracker
        Tracker(cell=1, misses=0, safe=False)
    """

    def __init__(
        self,
        policy: Plan | str | Path,
        cell: int | None = None,
        *,
        at: tuple[float, float] | None = None,
        mode: int | None = None,
        seed: int = 0,
        world: Any = None,
    ) -> None:
        self._policy = _plan(policy)
        self._task = self._policy.task
        _check_world(world, self._task)
        self.key, self.misses, self.steps = 0, 0, 0
        self._filter = None if world is None else BeliefFilter(world.kernel, world.modes)
        self._reports = None if world is None else Reports(world)
        self._belief: Array = np.zeros((1, 0))  # [1, Z] where the motion is known
        self.seed = whole_number("tracker: seed", seed, 0)
        found = self._one("tracker", cell, at)
        if found is None:
            raise UserError("tracker: no cell and no at, expected the first detection")
        self._locate("tracker", found, mode, first=True)

    def __repr__(self) -> str:
        if self._exited:
            return "Tracker(exited)"
        return f"Tracker(cell={self.cell}, misses={self.misses}, safe={self.safe})"

    @property
    def cell(self) -> int:
        """The cell of the last detection."""
        return int(self._task.keys.cell(self.key))

    @property
    def safe(self) -> bool:
        """Whether the safe action is due: all sensors on."""
        return self.misses > self._task.t_max and not self._exited

    def belief(self) -> Array:
        """`[M]` probability of each cell now, after the last report.

        Raises:
            UserError: the motion is not known, or the target has exited.
        """
        self._check_followed("belief()")
        if self._filter is None:
            raise UserError("belief(): the motion is not known, expected tracker(..., world=...)")
        return self._filter.cells(self._belief)[0]

    def report(
        self,
        cell: int | None = None,
        *,
        at: tuple[float, float] | None = None,
        mode: int | None = None,
    ) -> None:
        """The outcome of the step.

        Args:
            cell: in which the target was located; None if no sensor reported it.
            at: its position in place of a cell, as of `Tracker`.
            mode: of the target there, where a detection gives it.

        Raises:
            UserError: no `sensors()` before, or none of them sees this cell; the cell is outside the grid; the mode is
                missing, or given where detections do not reveal it; the target has exited.
        """
        self._check_asked()
        cell = self._one("report", cell, at)
        if cell is None:
            if mode is not None:
                raise UserError(f"report: mode={mode} without a cell, expected none")
            if self._filter is not None and self._reports is not None:
                chance = self._reports(self._action()[None], np.array([self.misses]))
                self._belief = self._filter.miss(self._filter.predict(self._belief), chance)
            # The clock stands still where the safe action misses.
            self.misses = min(self.misses + 1, self._task.num_choices)
        else:
            self._locate("report", cell, mode)
        self._on = None
        self.steps += 1

    def exited(self) -> None:
        """The target has left the grid; nothing follows.

        Raises:
            UserError: it had before.
        """
        self._check_followed("exited()")
        self._exited, self._on = True, None

    def state(self) -> dict[str, Any]:
        """All that is needed to go on later, as JSON takes it; see `restore`."""
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        belief = None if self._filter is None else self._belief[0].tolist()
        own = {"on": self._on, "exited": self._exited, "belief": belief}
        return {"task": self._facts(), **numbers, **own}

    @classmethod
    def restore(
        cls, policy: Plan | str | Path, state: Mapping[str, Any], world: Any = None
    ) -> Self:
        """The tracker of a `state()`, with the same policy or another one of the same grid and memory.

        Raises:
            UserError: the state is of another grid, other sensors or another memory, or is no state.
        """
        plan = _plan(policy)
        task = plan.task
        # Any mode: key and belief are replaced below.
        tracker = cls(plan, 0, mode=0 if task.keys.modes > 1 else None, world=world)
        tracker._check_state(state)
        most = {"key": task.num_keys - 1, "misses": task.num_choices}
        for name in _NUMBERS:
            found = whole_number(f"state: {name}", state[name], 0, most.get(name, math.inf))
            setattr(tracker, name, found)
        if not isinstance(state["exited"], bool):
            raise UserError("state: expected True or False as exited")
        tracker._on, tracker._exited = tracker._restored(state["on"]), state["exited"]
        if tracker._filter is not None:
            tracker._belief = probabilities(state["belief"], tracker._belief.shape[1])
        return tracker

    def _locate(self, call: str, cell: int, mode: int | None, *, first: bool = False) -> None:
        """Note a detection; nothing is changed where it is refused."""
        task, keys = self._task, self._task.keys
        place = np.int64(whole_number(f"{call}: cell", cell, 0, task.num_cells - 1))
        if (mode is not None) != (keys.modes > 1):
            wanted = f"one of 0 ... {keys.modes - 1}" if keys.modes > 1 else "none"
            raise UserError(f"{call}: mode={mode}, expected {wanted}")
        own = 0 if mode is None else whole_number(f"{call}: mode", mode, 0, keys.modes - 1)
        if not first:
            self._check_seen(call, int(place))
        before = np.int64(self.key)
        key = keys.start(place, own) if first else keys.next(before, self.misses, place, own)
        self.key, self.misses = int(key), 0
        if self._filter is not None:
            told = None if mode is None else np.array([mode])
            predicted = 1.0 if first else self._filter.predict(self._belief)
            self._belief = self._filter.detect(np.array([place]), told, predicted)

    def _chosen(self) -> list[int]:
        """See `Following`."""
        policy = self._policy
        sensors = np.array(policy.sensors(self.key, self.misses), np.int64)
        kept = self._possible(sensors)
        sensors = sensors[kept]
        if isinstance(policy, OnnxTable) or policy.deterministic:
            return sensors.tolist()
        # A generator for each step: the state then holds two numbers in place of a generator.
        draws = np.random.default_rng([self.seed, self.steps]).random(len(sensors))
        if policy.k is not None:
            # The k largest of independent uniforms are a uniformly random subset of size k.
            return np.sort(sensors[np.argsort(-draws)[: policy.k]]).tolist()
        return sensors[draws < policy.chances(self.key, self.misses)[kept]].tolist()

    def _possible(self, sensors: IndexArray) -> BoolArray:
        """See `Following`."""
        start = None if self.safe else np.full(len(sensors), self.cell)
        possible = self._task.choosable(start, sensors)
        return np.ones(len(sensors), bool) if possible is None else possible


def _plan(policy: Plan | str | Path) -> Plan:
    """The policy, which may be in a file.

    Raises:
        UserError: it is no policy of one target, the file holds none, or it exceeds the budget.
    """
    if not isinstance(policy, str | Path):
        if not (hasattr(policy, "sensors") and hasattr(policy, "task")):
            raise UserError(
                f"tracker: a {type(policy).__name__}, expected a policy of one target, or its file"
            )
        if isinstance(policy, PolicyTable):
            policy.check_fits(policy.task)
        return policy
    if (kind := Path(policy).suffix) not in (".npz", ".onnx"):
        raise UserError(f"tracker: {policy}: expected a policy.npz or a policy.onnx")
    return OnnxTable(policy) if kind == ".onnx" else _plan(load_policy(Path(policy))[0])


def _check_world(world: Any, task: Task) -> None:
    """Check that a world, where there is one, has a motion, and the grid, the clock, sensors and modes of a task.

    Raises:
        UserError: it has none, or has others.
    """
    if world is None:
        return
    motion = isinstance(world, Task) and hasattr(world, "kernel")
    if not motion or _sensing(world) != _sensing(task):
        grid = f"{task.rows} x {task.columns} cells, t_max {task.t_max}"
        sensors = f"{task.total_sensors} sensors, with the policy's footprints"
        raise UserError(f"tracker: world: expected a World of {grid} and {sensors}")
    if task.revealed not in (1, world.modes):
        raise UserError(f"tracker: world: {world.modes} modes, expected {task.revealed}")


def _sensing(task: Task) -> tuple[object, ...]:
    """The facts on which reports to a tracker depend, but for probabilities."""
    return task.size, task.t_max, task.total_sensors, task.footprints
