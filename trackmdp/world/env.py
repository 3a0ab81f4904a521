"""The tracking environment: TorchRL specs, reset and step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from trackmdp.errors import UserError
from trackmdp.world.outcomes import Costs, Reports
from trackmdp.world.render import PICTURE_LEGEND, pixels, text_rows
from trackmdp.world.targets import make_targets
from trackmdp.world.tracks import Problem
from trackmdp.world.windows import Sight, Window

_FLAGS = ("done", "terminated", "truncated")


class TrackEnv(EnvBase):
    """A batch of independent targets on one sensing grid (paper, Sections II and IV).

    One step, in this order: the policy has chosen `action`; the target moves; if it exits, the episode terminates with
    reward 0; else if it has been missed t_max + 1 times in a row the safe action replaces `action` and locates it;
    else it is located exactly where its cell's sensor is on. Sensors that miss (`detection` in the world) locate it
    with their probability; a safe action that misses is repeated, while the clock stands still, until it locates it.
    Sensors with footprints (`coverage`) locate it exactly where one that covers its cell is on.

    On recorded tracks the target goes along one of them; where its recording stops before it exits, the episode is
    truncated.

    What the tracker knows is observed:

    - `last_cell` `[*B]` int64, the cell of the last detection, x_{l(k)};
    - `steps_since_detection` `[*B]` int64, n(k), 0 ... t_max + 1;
    - `action_history` `[*B, t_max+1, K]` bool, the actions since then; slots n and later are empty;
    - `key` `[*B]` int64, only where `task.memory` is more than the cell: what was remembered at the last detection;
    - `step_count` `[*B]` int64, only with `max_steps` in the world.

    The true cell is in no spec and no tensordict, so that no encoder or transform can read the answer; `target` shows
    it to logs and tests. TorchRL carries from one step to the next only what is observed, so the environment holds its
    state itself and reads nothing but `action`: transforms may scale, join or delete what is observed. The tensors
    observed are those of the state: whoever writes to them in place moves the target's clock.

    `torch.compile(env.step_and_maybe_reset, fullgraph=True)` gives one graph and the same bits, as it does of `step`,
    `reset` and ``rollout(..., break_when_any_done=False)``, whose steps are unrolled: keep it to a few. On a CPU it
    does not pay: what torch 2.13 makes of sums and masks of bits is several times slower than the plain step.

    An `action` `[*B, K]` bool is a set of sensors. Without `window` in the world these are all sensors: K = M and
    sensor k is that of cell k, or K = S with footprints. With a window K = (2W + 1)² and actions, those remembered
    included, are in the local numbers of `Window`, as seen from `last_cell`: a sensor farther away cannot be chosen,
    and one outside the grid costs and senses nothing.

    Args:
        world: the task and the target's motion, or recorded tracks.
        batch_size: B, a number of targets or their shape: `8`, `(4, 2)`, or `()` for a single one.
        seed: seed of the run; the generators' names begin with `stream`.
        stream: name that keeps this environment's draws apart from all others.
        device: where the tensors live.

    Raises:
        UserError: a step was asked for before the first reset.
    """

    def __init__(
        self,
        world: Problem,
        batch_size: int | Sequence[int],
        *,
        seed: int = 0,
        stream: str = "world",
        device: torch.device | str = "cpu",
    ) -> None:
        shape = torch.Size([batch_size] if isinstance(batch_size, int) else batch_size)
        # A reset leaves no row done. Without the option TorchRL 0.14.1 looks whether one is after each reset, with an
        # `if` on a tensor (`_reset_check_done`), which no graph of `torch.compile` can hold.
        super().__init__(device=torch.device(device), batch_size=shape, allow_done_after_reset=True)
        self.num_envs, self.max_steps = shape.numel(), world.max_steps
        self.num_cells, self.t_max = world.num_cells, world.t_max
        self._stream, self._grid = stream, world.size
        self._targets = make_targets(world, self.device)
        self._window, self._sight = Window.of(world, self.device), Sight(world, self.device)
        self.num_sensors, self._covered = world.num_sensors, world.covered
        self._costs, self._reports, self._safe = Costs(world, self.device), Reports(world, self.device), world.safe
        self._keys = world.keys if world.keyed else None
        # Shared by all steps that truncate nothing; handed out as a clone only.
        self._no = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        self._every = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        # By its keys `[num_envs, ...]`; empty before the first reset. Its tensors are replaced, never written to: those
        # observed are the same ones.
        self._state: dict[str, Tensor] = {}
        # For `render`: the last action, from which cells and after how many misses it was chosen, and masks of the rows
        # begun anew since.
        self._acted: tuple[Tensor, Tensor, Tensor] | None = None
        self._begun: list[Tensor] = []
        self._make_specs()
        self._set_seed(seed)

    def __repr__(self) -> str:
        grid = f"{self._grid[0]} x {self._grid[1]} cells, {self.num_sensors} sensors, t_max={self.t_max}"
        limit = f", max_steps={self.max_steps}" if self.max_steps else ""
        return f"{type(self).__name__}({grid}{limit}, batch_size={list(self.batch_size)}, device={self.device})"

    @property
    def target(self) -> Tensor:
        """`[*B]` int64, the true cell, M once exited; for logs and tests, no policy is shown it."""
        return self._shaped(self._now, ("target",))["target"]

    @property
    def _now(self) -> dict[str, Tensor]:
        if not self._state:
            raise UserError("TrackEnv: a step before the first reset, expected env.reset()")
        return self._state

    def render(self, mode: str = "rgb_array", row: int = 0) -> npt.NDArray[np.uint8] | str:
        """The grid after the last step: the target, and the sensors that were on, none if an episode has just begun.

        Args:
            mode: "rgb_array" for `[16 rows, 16 columns, 3]` uint8, or "text".
            row: which target of the batch, as if all were in a row.

        Raises:
            UserError: another mode, or a row that is not there.
        """
        if mode not in ("rgb_array", "text") or not 0 <= row < self.num_envs:
            raise UserError(f"render({mode!r}, {row}): expected rgb_array or text, a row of 0 ... {self.num_envs - 1}")
        cell, n = (int(self._now[key][row]) for key in ("target", "steps_since_detection"))
        on = np.zeros(self.num_cells, dtype=bool)
        if self._acted is not None and not any(rows[row] for rows in self._begun):
            action, last, misses = (each[row : row + 1] for each in self._acted)
            on |= self._covered(self._window.to_global(last, action)[0].cpu().numpy()) | bool(misses > self.t_max)
        draw = pixels if mode == "rgb_array" else text_rows
        picture = draw(self._grid, cell, on, found=n == 0)
        return picture if isinstance(picture, np.ndarray) else "\n".join([*picture, PICTURE_LEGEND])

    def _make_specs(self) -> None:
        b, m, k, choices = self.batch_size, self.num_cells, self.num_sensors, self.t_max + 1
        index: dict[str, Any] = {"shape": b, "dtype": torch.int64, "device": self.device}
        observation = Composite(
            # n takes t_max + 2 values: 0 ... t_max + 1, the last one with the safe action forced.
            last_cell=Categorical(m, **index),
            steps_since_detection=Categorical(choices + 1, **index),
            action_history=Binary(k, shape=(*b, choices, k), dtype=torch.bool, device=self.device),
            shape=b,
        )
        if self._keys:
            observation["key"] = Categorical(self._keys.num_keys, **index)
        if self.max_steps:
            observation["step_count"] = Categorical(self.max_steps + 1, **index)
        self.observation_spec = observation
        self._observed = tuple(observation.keys())
        self.action_spec = Binary(k, shape=(*b, k), dtype=torch.bool, device=self.device)
        self.reward_spec = Unbounded((*b, 1), device=self.device)
        flag = Binary(1, shape=(*b, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=b)
        self._shown = (*self._observed, "reward", *_FLAGS)

    def _set_seed(self, seed: int | None) -> None:
        self._targets.seed(seed or 0, self._stream)
        self._reports.seed(seed or 0, self._stream)

    def snapshot(self) -> dict[str, dict[str, Tensor]]:
        """The state of all targets `[num_envs, ...]` and of the generators, for a checkpoint."""
        return {"rows": dict(self._state), "generators": self._targets.state() | self._reports.state()}

    def restore(self, snapshot: Mapping[str, Mapping[str, Tensor]]) -> TensorDict:
        """Go on where a `snapshot` was taken; returns what is observed there."""
        self._state = {key: value.to(self.device) for key, value in snapshot["rows"].items()}
        self._targets.load_state(snapshot["generators"])
        self._reports.load_state(snapshot["generators"])
        return self._shaped(self._now, self._observed)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        """Begin anew the rows whose `_reset` mask is set, all without one; returns what is observed in every row."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or not self._state:
            self._state, self._acted = self._fresh(self._every), None
        else:
            self._begin(mask.reshape(-1))
        return self._shaped(self._state, self._observed)

    def _begin(self, rows: Tensor) -> None:
        """New episodes in the rows of a mask; the others are made as well, so that shapes stay fixed, and left out."""
        if torch.compiler.is_compiling():
            # No shape and no branch may depend on how many rows there are.
            fresh = self._fresh(rows)
            self._state = {key: _where(rows, fresh[key], value) for key, value in self._state.items()}
        elif len(at := rows.nonzero().squeeze(-1)):
            fresh = self._fresh(rows)
            # The largest part by far, and empty already where the episode did not end in a miss.
            same = () if self._state["steps_since_detection"][at].any() else ("action_history",)
            self._state = {
                key: value if key in same else value.index_copy(0, at, fresh[key][at])
                for key, value in self._state.items()
            }
        self._begun.append(rows)

    def _fresh(self, rows: Tensor) -> dict[str, Tensor]:
        """Initial states s_0 = (x_0, 0, ∅), the target located, `[num_envs, ...]`; used are the `rows` of a mask."""
        state = self._targets.start(rows)
        start = state["target"]
        state |= {
            "last_cell": start.clone(),
            "steps_since_detection": torch.zeros_like(start),
            "action_history": torch.zeros(
                *start.shape, self.t_max + 1, self.num_sensors, dtype=torch.bool, device=self.device
            ),
        }
        if self._keys:
            state["key"] = self._keys.start(start, self._targets.mode(state))
        if self.max_steps:
            state["step_count"] = torch.zeros_like(start)
        return state

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._shaped(self._stepped(tensordict["action"]), self._shown)

    def _stepped(self, action: Tensor) -> dict[str, Tensor]:
        """One step of all targets in a row, `[num_envs, ...]`, from an action `[*B, K]`."""
        flat = action.reshape(self.num_envs, self.num_sensors)
        now = self._now
        self._acted, self._begun = (flat, now["last_cell"], now["steps_since_detection"]), []
        draws, reports = self._targets.draw(self._every), self._reports.draw(self._every)
        following = self.advance(now | {"action": flat}, draws, reports)
        self._state = {key: following[key] for key in self._state}
        return following

    def _shaped(self, rows: Mapping[str, Tensor], keys: Sequence[str]) -> TensorDict:
        """The TensorDict `[*B]` of some of what is known of all targets in a row."""
        chosen = {key: rows[key] for key in keys}
        if len(self.batch_size) != 1:
            chosen = {key: value.reshape((*self.batch_size, *value.shape[1:])) for key, value in chosen.items()}
        return TensorDict(chosen, self.batch_size, device=self.device)

    def advance(
        self, state: Mapping[str, Tensor] | TensorDictBase, draws: Tensor, reports: Tensor | None = None
    ) -> dict[str, Tensor]:
        """The step as a function of state and `action` `[B, ...]` and of uniform draws `[B]` of motion and reports."""
        action, last, n = state["action"], state["last_cell"], state["steps_since_detection"]
        moved = self._targets.move(state, draws)
        target = moved["target"]
        in_grid = target < self.num_cells
        sensed = self._sight.sees(action, last, target)
        # n = t_max + 1: the policy's action does not count any more.
        forced = n > self.t_max
        located = (sensed | forced) & in_grid & self._reports.seen(target, forced, reports)
        missed, spent = in_grid & ~located, self._costs.sensing_cost(action, last)
        following = moved | {
            # On the exit step `last` stays: the spec has no cell M for it, and done ends the row anyway.
            "last_cell": torch.where(located, target, last),
            # n + 1 on a miss, 0 on a detection and on the exit step; the clock stands still if the safe action misses.
            "steps_since_detection": (n + 1 if self._safe else (n + 1).clamp_max(self.t_max + 1)) * missed,
            "action_history": self._remember(state["action_history"], action, n, missed),
            "reward": self._costs.pseudo_reward(spent, located, forced, in_grid).unsqueeze(-1),
        }
        if self._keys:
            # As with `last_cell`, what is worked out for a target that has exited is thrown away.
            key = self._keys.next(state["key"], n, target.clamp_max(self.num_cells - 1), self._targets.mode(moved))
            following["key"] = torch.where(located, key, state["key"])
        terminated = ~in_grid.unsqueeze(-1)
        cut = self._targets.cut(moved)
        truncated = self._no if cut is None else cut.unsqueeze(-1)
        if self.max_steps:
            following["step_count"] = state["step_count"] + 1
            # Time limit and exit on one step: the exit counts, for nothing is left to bootstrap from.
            truncated = (following["step_count"] >= self.max_steps).unsqueeze(-1) & ~terminated | truncated
        # A clone, for `truncated` may be the shared `_no`.
        following |= {"terminated": terminated, "truncated": truncated.clone(), "done": terminated | truncated}
        return following

    def _remember(self, history: Tensor, action: Tensor, n: Tensor, missed: Tensor) -> Tensor:
        """h_{k+1}: `action` in slot n where the target was missed, empty elsewhere; misses are few."""
        # With t_max = 1: missed at n = 0 gives slots (a, -), missed again at n = 1 gives (a, b); n = 2 is forced.
        if torch.compiler.is_compiling():
            # All rows, since a graph has no shape that depends on how many were missed; fused into one loop.
            here = torch.arange(self.t_max + 1, device=n.device) == n.unsqueeze(-1)
            return _where(missed, torch.where(here.unsqueeze(-1), action.unsqueeze(1), history), False)
        rows = missed.nonzero().squeeze(-1)
        # Slots n and later are empty: with n = 0 everywhere, as with all sensors on, all are, and stay so.
        if not len(rows) and not n.any():
            return history
        kept = torch.zeros_like(history)
        kept[rows] = history[rows]
        if not self._safe:  # an action that the safe one replaced is none
            rows = rows[n[rows] <= self.t_max]
        kept[rows, n[rows]] = action[rows]
        return kept

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """TorchRL's step and auto-reset in one pass; bit-equal to the stock path, twice as fast."""
        # `next` holds the state that was reached, the returned tensordict the one to act on: where an episode ended
        # they differ.
        following = self._stepped(tensordict["action"])
        tensordict.set("next", self._shaped(following, self._shown))
        done = following["done"]
        self._begin(done.squeeze(-1))
        flags = {key: torch.zeros_like(done) for key in _FLAGS}
        return tensordict, self._shaped(self._state | flags, (*self._observed, *_FLAGS))


def _where(rows: Tensor, this: Tensor, that: Tensor | bool) -> Tensor:
    """`this` `[B, ...]` in the rows of a mask `[B]`, `that` in the others."""
    return torch.where(rows.reshape(-1, *[1] * (this.ndim - 1)), this, that)
