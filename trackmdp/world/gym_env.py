"""`TrackEnv` as Gymnasium knows environments: one target, or a batch of them."""

from __future__ import annotations

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

from trackmdp.errors import UserError
from trackmdp.world.env import TrackEnv
from trackmdp.world.make import make_world
from trackmdp.world.tracks import Problem

Observation: TypeAlias = dict[str, Any]
_MODES = {"ansi": "text", "rgb_array": "rgb_array"}


class _Tracking:
    """What the single and the vector environment share: the problem, its seeding, its picture."""

    observation_space: Any
    np_random: Any
    _np_random: Any

    def _make(
        self, world: Problem | None, options: dict[str, Any], render_mode: str | None, shape: tuple[int, ...]
    ) -> tuple[spaces.Dict, spaces.MultiBinary]:
        """Set the three up; returns the spaces of one target."""
        if world is not None and options:
            raise UserError(f"{', '.join(options)}: expected either a world, or options to make one of")
        self.world, self.render_mode = make_world(**options) if world is None else world, render_mode
        if render_mode is not None and render_mode not in _MODES:
            raise UserError(f"render_mode={render_mode}: expected one of {', '.join(_MODES)}")
        self._env = TrackEnv(self.world, shape)
        # Those of the environment's specs, without its batch.
        seen: dict[str, spaces.Space[Any]] = {
            key: spaces.MultiBinary(spec.shape[-2:]) if isinstance(spec, Binary) else spaces.Discrete(spec.space.n)
            for key, spec in self._env.observation_spec.items()
        }
        return spaces.Dict(seen), spaces.MultiBinary(self._env.num_sensors)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new episode of each target; with a seed, the first one of it. There are no `options`."""
        begun = self._np_random is not None
        super().reset(seed=seed, options=options)  # type: ignore[misc]  # of Gymnasium's own class, the next in line
        if seed is not None or not begun:
            self._env.set_seed(int(self.np_random.integers(2**31)))
        return self._seen(self._env.reset()), self._info()

    def _seen(self, state: TensorDictBase) -> Observation:
        """The observation in numpy, of the dtypes of its space; copies, for the tensors are the environment's own."""
        seen = {key: state[key].numpy().astype(part.dtype) for key, part in self.observation_space.items()}
        # Discrete spaces hold numpy's numbers, not arrays of none.
        return {key: value if value.ndim else value[()] for key, value in seen.items()}

    def _info(self) -> dict[str, Any]:
        target = self._env.target.numpy()
        return {"target": target if target.ndim else int(target)}

    def render(self) -> Any:
        """The (first target's) grid after the last step, in the render mode."""
        return None if self.render_mode is None else self._env.render(_MODES[self.render_mode])


class TrackGym(_Tracking, gymnasium.Env[Observation, npt.NDArray[np.int8]]):
    """One target (paper, Section II); `info["target"]` is its true cell, M once it has exited.

    An observation has the keys of `TrackEnv`, an action is a `MultiBinary(K)`: the sensors to switch on.
    Stable-Baselines3 reads it with its `MultiInputPolicy`.

    Args:
        world: the world, or recorded tracks; None to make one of `options`.
        render_mode: "ansi" for text, "rgb_array" for pixels, or None.
        options: those of `make_world`.

    Raises:
        UserError: both a world and options are given, or one of them is wrong.
    """

    metadata: dict[str, Any] = {"render_modes": list(_MODES), "render_fps": 4}  # noqa: RUF012, Gymnasium's own form

    def __init__(self, world: Problem | None = None, *, render_mode: str | None = None, **options: Any) -> None:
        self.observation_space, self.action_space = self._make(world, options, render_mode, ())

    def step(self, action: npt.NDArray[np.int8]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step with the sensors of `action` `[K]` on."""
        after = self._env.step(_acting(action, ()))["next"]
        ends = (bool(after[key].item()) for key in ("terminated", "truncated"))
        return self._seen(after), after["reward"].item(), *ends, self._info()


class TrackVector(_Tracking, VectorEnv[Observation, npt.NDArray[np.int8], npt.NDArray[Any]]):
    """A batch of targets stepped at once; an episode that ends is begun anew in the same step.

    `infos["target"]` `[B]` are the true cells at the end of the step; where an episode ended, `infos["final_obs"]` is
    what it ended with, and `infos["final_info"]["target"]` where.

    Args:
        num_envs: B.
        world: see `TrackGym`, as are `render_mode` and `options`; the picture is that of the first target.
        render_mode: see `TrackGym`.
        options: see `TrackGym`.

    Raises:
        UserError: both a world and options are given, or one of them is wrong.
    """

    metadata: dict[str, Any] = {**TrackGym.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self, num_envs: int = 1, world: Problem | None = None, *, render_mode: str | None = None, **options: Any
    ) -> None:
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = self._make(world, options, render_mode, (num_envs,))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def step(
        self, actions: npt.NDArray[np.int8]
    ) -> tuple[Observation, npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any], dict[str, Any]]:
        """One step with the sensors of `actions` `[B, K]` on."""
        after = self._env.step(_acting(actions, (self.num_envs,)))["next"]
        reward, terminated, truncated, done = (
            after[key].squeeze(-1).numpy() for key in ("reward", "terminated", "truncated", "done")
        )
        infos: dict[str, Any] = {}
        seen = self._seen(after)
        if done.any():
            infos = self._final(seen, done)
            # The state before, too: TorchRL puts the new rows into it.
            begun = self._env.reset(after.select(*seen).set("_reset", after["done"]))
            seen = self._seen(begun)
        return seen, reward, terminated, truncated, infos | self._info()

    def _final(self, seen: Observation, done: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """What ended, in the form of Gymnasium's own vector environments: a mask beside each key."""
        # Not by `VectorEnv._add_info`, a row at a time: steps of 1,024 targets took half as long again.
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(done):
            final[row] = {key: value[row] for key, value in seen.items()}
        info = {"target": np.where(done, self._env.target.numpy(), 0), "_target": done}
        return {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done}


def _acting(action: npt.ArrayLike, shape: tuple[int, ...]) -> TensorDict:
    return TensorDict({"action": torch.as_tensor(np.asarray(action), dtype=torch.bool)}, shape)
