"""`TrackEnv` in Gymnasium's interface: one target, or a batch of them."""

from __future__ import annotations

import sys
from inspect import signature
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary

from trackmdp.config.options import GROUPS, options
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.gym_space import AtMost
from trackmdp.errors import UserError
from trackmdp.world.group import Group
from trackmdp.world.make import make_world
from trackmdp.world.problem import Problem

Observation: TypeAlias = dict[str, Any]
_MODES = {"ansi": "text", "human": "text", "rgb_array": "rgb_array"}


class _Tracked:
    """Common part of the single and the vector environment: the problem, its seeding, its picture."""

    observation_space: Any
    np_random: Any

    def _make(
        self,
        world: Problem | Group | None,
        given: dict[str, Any],
        render_mode: str | None,
        shape: tuple[int, ...],
    ) -> tuple[spaces.Dict, spaces.MultiBinary]:
        """Make the environment from a world or from the options `given`; returns the spaces of one target."""
        _check_names(given)
        if world is not None and given:
            raise UserError(
                f"{', '.join(given)}: expected either a world, or options to make one of"
            )
        if render_mode is not None and render_mode not in _MODES:
            raise UserError(f"render_mode={render_mode}: expected one of {', '.join(_MODES)}")
        self.world = make_world(**given) if world is None else world
        self.render_mode = render_mode
        self._env = TrackEnv(self.world, shape)
        seen = {key: _space(spec, len(shape)) for key, spec in self._env.observation_spec.items()}
        count, budget = self._env.num_sensors, getattr(self._env.action_spec, "budget", None)
        sets = spaces.MultiBinary(count) if budget is None else AtMost(count, budget)
        return spaces.Dict(seen), sets

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new episode of each target; with a seed, the first one of it. There are no `options`."""
        super().reset(seed=seed, options=options)  # type: ignore[misc]  # of Gymnasium's own class, the next in line
        if seed is not None or not self._env._tracking.state:  # the first reset
            self._env.set_seed(int(self.np_random.integers(2**31)))
        return self._seen(self._env.reset()), self._info()

    def _stepped(self, action: npt.ArrayLike) -> TensorDictBase:
        """The state after one step with the sensors of `action` on, reward and flags included."""
        # Not `step`, in which TorchRL would check a wrong shape first, against the batch of the tensordict.
        return self._env._step(TensorDict({"action": torch.as_tensor(np.asarray(action))}, []))

    def _seen(self, state: TensorDictBase) -> Observation:
        """The observation in numpy, of the dtypes of its space; copies, for the tensors are the environment's own."""
        seen = {
            key: state[key].numpy().astype(part.dtype)
            for key, part in self.observation_space.items()
        }
        # Discrete spaces hold numpy's numbers, not arrays without dimensions.
        return {key: value if value.ndim else value[()] for key, value in seen.items()}

    def _info(self) -> dict[str, Any]:
        """The true cells, asked for once at the end of each step, where a human sees its picture."""
        if self.render_mode == "human":
            self.render()
        target = self._env.target.numpy()
        return {"target": target if target.ndim else int(target)}

    def render(self) -> Any:
        """The grid of the first target or group after the last step, in its mode; "human" prints it at each step."""
        if self.render_mode is None:
            return None
        picture = self._env.render(_MODES[self.render_mode])
        if self.render_mode != "human":
            return picture
        sys.stdout.write(f"{picture}\n\n")
        return None


class TrackGym(_Tracked, gymnasium.Env[Observation, npt.NDArray[np.int8]]):
    """One target (paper, Section II); `info["target"]` is its true cell, M once it has exited; of a group `[K]`.

    An observation has the keys of `TrackEnv`, `action_history` as a `Box` of 0 and 1; an action is a `MultiBinary(K)`:
    the sensors to switch on; those that `action_space` draws keep to the budget. Stable-Baselines3 reads it with its
    `MultiInputPolicy`, TorchRL with `GymEnv`. Neither knows of a budget, and sets beyond it are refused: with one, take
    `TrackEnv`.

    Args:
        world: the world, recorded tracks or a group of targets; None to make one of `options`.
        render_mode: "ansi" for text, "human" to print it at each step, "rgb_array" for pixels, or None.
        options: options of `make_world`.

    Raises:
        TypeError: an option is unknown.
        UserError: both a world and options are given, or one of them is wrong; in `step`, an action has another shape
            or values other than 0 and 1, or more sensors on than the budget.
    """

    metadata: dict[str, Any] = {"render_modes": list(_MODES), "render_fps": 4}  # noqa: RUF012, Gymnasium's own form

    def __init__(
        self,
        world: Problem | Group | None = None,
        *,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        self.observation_space, self.action_space = self._make(world, options, render_mode, ())

    def step(
        self, action: npt.NDArray[np.int8]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step with the sensors of `action` `[K]` on."""
        after = self._stepped(action)
        ends = (bool(after[key].item()) for key in ("terminated", "truncated"))
        return self._seen(after), after["reward"].item(), *ends, self._info()


class TrackVector(_Tracked, VectorEnv[Observation, npt.NDArray[np.int8], npt.NDArray[Any]]):
    """A batch of targets stepped at once; an episode that ends is begun anew in the same step.

    `infos["target"]` `[B]`, of groups `[B, K]`, are the true cells at the end of the step; where an episode ended,
    `infos["final_obs"]` is its last observation, and `infos["final_info"]["target"]` the last cell.

    Args:
        num_envs: B.
        world: see `TrackGym`, as for `render_mode` and `options`; the picture shows the first target or group.
        render_mode: see `TrackGym`.
        options: see `TrackGym`.

    Raises:
        TypeError: see `TrackGym`.
        UserError: see `TrackGym`.
    """

    metadata: dict[str, Any] = {**TrackGym.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        world: Problem | Group | None = None,
        *,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = self._make(
            world, options, render_mode, (num_envs,)
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def step(
        self, actions: npt.NDArray[np.int8]
    ) -> tuple[Observation, npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], dict[str, Any]]:
        """One step with the sensors of `actions` `[B, K]` on."""
        after = self._stepped(actions)
        reward, terminated, truncated, done = (
            after[key].squeeze(-1).numpy() for key in ("reward", "terminated", "truncated", "done")
        )
        infos: dict[str, Any] = {}
        seen = self._seen(after)
        if done.any():
            infos = self._final(seen, done)
            # With the state before: TorchRL puts the new rows into it.
            begun = self._env.reset(after.select(*seen).set("_reset", after["done"]))
            seen = self._seen(begun)
        return seen, reward, terminated, truncated, infos | self._info()

    def _final(self, seen: Observation, done: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """Last observations, in the form of Gymnasium's own vector environments: a mask beside each key."""
        # Not by `VectorEnv._add_info`, a row at a time: steps of 1,024 targets took half as long again.
        final = np.full(self.num_envs, None, object)
        for row in np.flatnonzero(done):
            final[row] = {key: value[row] for key, value in seen.items()}
        target = self._env.target.numpy()
        ended = done.reshape(-1, *[1] * (target.ndim - 1))
        info = {"target": np.where(ended, target, 0), "_target": done}
        return {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done}


def _space(spec: Any, batch_dims: int) -> spaces.Space[Any]:
    """The space of one target, or of one group of them, from a spec of the environment."""
    shape = spec.shape[batch_dims:]
    if not isinstance(spec, Binary):
        values = spec.space.n
        return spaces.MultiDiscrete(np.full(shape, values)) if shape else spaces.Discrete(values)
    if len(shape) == 1:
        return spaces.MultiBinary(shape[0])
    # TorchRL 0.14.1 converts a `MultiBinary` of one dimension only.
    return spaces.Box(0, 1, tuple(shape), np.int8)


def _check_names(given: dict[str, Any]) -> None:
    """Refuse unknown options as Python does for arguments: wrappers try some out, `GymEnv` `frameskip`.

    Raises:
        TypeError: an option is unknown.
    """
    parameters = signature(make_world).parameters
    known, kernel = set(parameters), given.get("kernel", parameters["kernel"].default.value)
    if kernel in GROUPS["kernel"]:
        known |= set(options(GROUPS["kernel"][kernel]))
    for name in sorted(set(given) - known):
        raise TypeError(f"__init__() got an unexpected keyword argument {name!r}")
