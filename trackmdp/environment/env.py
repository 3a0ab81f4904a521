"""The tracking environment: TorchRL specs, reset and step."""

from __future__ import annotations

import inspect
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Self

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from trackmdp.environment.action_spec import at_most
from trackmdp.environment.dynamics import FLAGS, State
from trackmdp.environment.render import picture
from trackmdp.environment.tracking import Snapshot, Tracking
from trackmdp.errors import UserError
from trackmdp.machine import make_device
from trackmdp.sensing.actions import checked_action
from trackmdp.sensing.task import Task
from trackmdp.world.group import Group, check_problem
from trackmdp.world.problem import Problem


class TrackEnv(EnvBase):
    """A batch of independent targets on one sensing grid (paper, Sections II and IV).

    One step, in this order: the policy has chosen `action`; the target moves; if it exits, the episode terminates with
    reward 0; else if it has been missed t_max + 1 times in a row the safe action replaces `action` and locates it;
    else it is located if a sensor that is on reports it. The sensor of its cell does, or with footprints (`coverage`)
    any that covers it; sensors that miss (`detection` in the world) report it with their probability, independently.
    A safe action that misses is repeated, while the clock stands still, until it locates the target.

    On recorded tracks the target follows one of them; where its recording stops before it exits, the episode is
    truncated.

    Observed are:

    - `last_cell` `[*B]` int64, the cell of the last detection, x_{l(k)};
    - `steps_since_detection` `[*B]` int64, n(k), 0 ... t_max + 1;
    - `action_history` `[*B, t_max+1, K]` bool, the actions since then; slots n and later are empty;
    - `key` `[*B]` int64, only where `task.memory` is more than the cell: the memory of the last detections;
    - `step_count` `[*B]` int64, only with `max_steps` in the world;
    - `action_mask` `[*B, K]` bool, the sensors that can be chosen, only where a cell has no sensor, or a window limits
      footprints. Others may be switched on; they cost and report nothing.

    The true cell is in no spec and no tensordict, so that no encoder or transform can read the answer; `target` shows
    it to logs and tests. TorchRL carries from one step to the next only observations, so the environment holds its
    state itself and reads nothing but `action`: transforms may scale, join or delete observations. The tensors
    observed are those of the state: writing to them in place moves the target's clock.

    `torch.compile(env.step_and_maybe_reset, fullgraph=True)` gives one graph and the same bits, as for `step`, `reset`
    and ``rollout(..., break_when_any_done=False)``, which unrolls its steps: keep it to a few. On a CPU it does not
    pay: sums and masks of bits as compiled by torch 2.13 are several times slower than the plain step.

    An `action` `[*B, K]` of 0 and 1, of any dtype, is a set of sensors; those that `action_spec` draws keep to the
    budget. Without `window` in the world these are all sensors: K = M and sensor k covers cell k, or K = S with
    footprints. With a window K = (2W + 1)² and actions, those remembered included, are in the local numbers of
    `Window`, as seen from `last_cell`: a sensor farther away cannot be chosen, and one outside the grid costs and
    senses nothing.

    Of a `Group` K is the number of targets, and actions are `[*B, S]`. `last_cell` and `steps_since_detection` are
    `[*B, K]`; `present` `[*B, K]` bool shows which targets are in the grid; `action_history` `[*B, t_max+1, S]` holds
    the last actions, the latest first, since the last safe action, which locates all targets. The episode ends when
    the last target has left. On recorded tracks a target may enter later: it is then located, and before it
    `last_cell` is 0.

    Args:
        world: the task and the target's motion, recorded tracks, or a group of targets.
        batch_size: B, a number of targets or their shape: `8`, `(4, 2)`, or `()` for a single one.
        seed: seed of the run; the generators' names begin with `stream`.
        stream: name that keeps this environment's draws apart from all others.
        device: device of the tensors.

    Raises:
        UserError: `world` is no world, or several targets whose modes a detection reveals; `batch_size` is no shape,
            `seed` no integer from 0 on, or there is no such `device`; in `step`, an action has another shape, other
            values or more sensors on than the budget, or there was no reset before.

    Example:
        >>> from trackmdp import TrackEnv, make_world
        >>> TrackEnv(make_world(size=3), 8).rollout(5)["action_history"].shape
        torch.Size([8, 5, 2, 9])
    """

    def __init__(
        self,
        world: Problem | Group,
        batch_size: int | Sequence[int] = (),
        *,
        seed: int = 0,
        stream: str = "world",
        device: torch.device | str = "cpu",
    ) -> None:
        check_problem(world, "TrackEnv")
        # A reset leaves no row done. Without the option TorchRL 0.14.1 looks whether one is after each reset, with an
        # `if` on a tensor (`_reset_check_done`), which no graph of `torch.compile` can hold.
        super().__init__(
            device=make_device(device), batch_size=_shape(batch_size), allow_done_after_reset=True
        )
        if isinstance(world, Group) and world.hidden < world.modes:
            raise UserError(
                "TrackEnv: a Group whose modes a detection reveals, expected hidden ones"
            )
        task: Task = world.task if isinstance(world, Group) else world
        self._world = world
        self.num_envs, self.max_steps = self.batch_size.numel(), task.max_steps
        self.num_cells, self.num_sensors = task.num_cells, task.num_sensors
        self.t_max, self._grid, self._stream = task.t_max, task.size, stream
        self._budget, self._targets = task.budget, (len(world),) if isinstance(world, Group) else ()
        self._action_shape = (*self.batch_size, self.num_sensors)
        self._make_tracking(seed)
        self._make_specs(task)

    def _make_tracking(self, seed: int) -> None:
        """The targets, before their first reset, on the environment's device."""
        world, count, device = self._world, self.num_envs, self.device
        self._tracking = Tracking(world, count, device)
        self._none = torch.zeros((len(FLAGS), count, 1), dtype=torch.bool, device=device)
        self._set_seed(seed)

    def to(self, device: torch.device | str) -> Self:
        """Move the targets as they stand; draws begin anew from the seed, as each device has generators of its own."""
        before, state = self.device, self._tracking.state
        super().to(make_device(device))
        if self.device != before:
            self._make_tracking(self._seed)
            self._tracking.state = {key: each.to(self.device) for key, each in state.items()}
        return self

    def __repr__(self) -> str:
        grid = f"{self._grid[0]} x {self._grid[1]} cells, {self.num_sensors} sensors, t_max={self.t_max}"
        limit = f", max_steps={self.max_steps}" if self.max_steps else ""
        return f"{type(self).__name__}({grid}{limit}, batch_size={list(self.batch_size)}, device={self.device})"

    @property
    def target(self) -> Tensor:
        """`[*B]` int64, of a group `[*B, K]`: the true cell, M once exited; for logs and tests, not for policies."""
        return self._now.target().reshape((*self.batch_size, *self._targets))

    @property
    def _now(self) -> Tracking:
        if not self._tracking.state:
            raise UserError("TrackEnv: a step before the first reset, expected env.reset()")
        return self._tracking

    def render(self, mode: str = "rgb_array", row: int = 0) -> npt.NDArray[np.uint8] | str:
        """The grid after the last step: the targets, and the sensors that were on, none if an episode has just begun.

        Of several targets in one cell the first is shown.

        Args:
            mode: "rgb_array" for `[16 rows, 16 columns, 3]` uint8, or "text".
            row: number of the target or group, the batch flattened.

        Raises:
            UserError: another mode, a row that is not there, or there was no reset before.
        """
        if mode not in ("rgb_array", "text") or not 0 <= row < self.num_envs:
            raise UserError(
                f"render({mode!r}, {row}): expected rgb_array or text, a row of 0 ... {self.num_envs - 1}"
            )
        now = self._now
        found = now.state["steps_since_detection"][row] == 0
        shown = now.target()[row], now.covered(row), found
        cell, on, located = (each.cpu().numpy() for each in shown)
        return picture(mode, self._grid, cell, on, found=located)

    def _make_specs(self, task: Task) -> None:
        b = self.batch_size

        def bits(*shape: int, kind: type[Binary] = Binary) -> Binary:
            return kind(shape=torch.Size((*b, *shape)), dtype=torch.bool, device=self.device)

        # n takes t_max + 2 values: 0 ... t_max + 1, the last one with the safe action forced.
        values = {"last_cell": task.num_cells, "steps_since_detection": task.t_max + 2}
        values |= {"key": task.num_keys, "step_count": (task.max_steps or 0) + 1}
        place = torch.zeros(self._tracking.each, dtype=torch.int64, device=self.device)
        state = self._tracking.dynamics.start(place)
        del state["place"]
        observed = {
            name: Categorical(values[name], torch.Size((*b, *each.shape[1:])), self.device)
            if name in values
            else bits(*each.shape[1:])
            for name, each in state.items()
        }
        self.observation_spec = Composite(observed, shape=b)
        self.action_spec = bits(self.num_sensors, kind=at_most(task.budget, self.num_sensors))
        self.reward_spec = Unbounded((*b, 1), device=self.device)
        self.done_spec = Composite({name: bits(1) for name in FLAGS}, shape=b)
        self._observed = tuple(observed)
        self._shown = (*observed, "reward", *FLAGS)
        self._carried = (*observed, *FLAGS)

    def _set_seed(self, seed: int | None) -> None:
        self._tracking.seed(seed or 0, self._stream)
        self._seed = seed or 0

    def snapshot(self) -> dict[str, dict[str, Tensor]]:
        """The state of all targets `[num_envs, ...]` and of the generators, for a checkpoint."""
        return self._tracking.snapshot()

    def restore(self, snapshot: Snapshot) -> TensorDict:
        """Continue from a `snapshot`; returns the observation there.

        Raises:
            UserError: the snapshot is of another environment; this one stays as it is.
        """
        try:
            shown = self._shaped(snapshot["rows"], self._observed)
            if not self.observation_spec.is_in(shown.to(self.device)):
                raise ValueError("values out of range")
            self._tracking.load(snapshot)
        except (AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise UserError(f"snapshot: expected one of {self!r} ({reason})") from error
        return self._shaped(self._tracking.state, self._observed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        """Begin anew the rows with a set `_reset` mask, without a mask all; returns the observation of every row."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or not self._tracking.state:
            self._tracking.restart()
        else:
            self._tracking.begin(mask.reshape(-1, 1))
        return self._shaped(self._tracking.state, self._observed)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._shaped(self._stepped(tensordict["action"]), self._shown)

    def _stepped(self, action: Tensor) -> State:
        """One step of all targets in a row, `[num_envs, ...]`, from an action `[*B, K]`."""
        flat = checked_action(action, self._action_shape, "action", self._budget)
        if len(self.batch_size) != 1:
            flat = flat.reshape(self.num_envs, -1)
        return self._now.step(flat)

    def _shaped(self, rows: Mapping[str, Tensor], keys: Iterable[str]) -> TensorDict:
        """The TensorDict `[*B]` of the tensors `[num_envs, ...]` under some keys."""
        shape = self.batch_size
        chosen = {key: rows[key] for key in keys}
        if len(shape) != 1:
            chosen = {
                key: value.reshape((*shape, *value.shape[1:])) for key, value in chosen.items()
            }
        # The public constructor checks shape and device of each tensor, a third of the time of a step of one target.
        return TensorDict._new_unsafe(chosen, shape, device=self.device)

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """TorchRL's step and auto-reset in one pass; bit-equal to the stock path, twice as fast."""
        # `next` holds the state that was reached, the returned tensordict the one to act on: where an episode ended
        # they differ.
        following = self._stepped(tensordict["action"])
        tensordict.set("next", self._shaped(following, self._shown))
        self._tracking.begin(following["done"])
        flags = dict(zip(FLAGS, self._none.clone().unbind(0), strict=True))
        return tensordict, self._shaped(self._tracking.state | flags, self._carried)


def _shape(batch_size: int | Sequence[int]) -> torch.Size:
    """`batch_size` as a shape.

    Raises:
        UserError: it is no whole number and no sequence of them.
    """
    try:
        sides = batch_size if isinstance(batch_size, Iterable) else (batch_size,)
        shape = torch.Size([operator.index(side) for side in sides])
    except TypeError:
        shape = torch.Size([-1])
    if any(side < 1 for side in shape):
        raise UserError(f"batch_size={batch_size}: expected a number of targets or their shape")
    return shape


# TorchRL's metaclass has `*args, **kwargs`, which `help` and editors would show. Less `self`.
_signature = inspect.signature(TrackEnv.__init__)
TrackEnv.__signature__ = _signature.replace(parameters=list(_signature.parameters.values())[1:])
