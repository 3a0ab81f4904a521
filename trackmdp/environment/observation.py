"""The tracker's observation as one vector, for the transforms and networks of TorchRL."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch.nn.functional import one_hot
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import ObservationTransform

from trackmdp.errors import UserError
from trackmdp.sensing.task import Task

_KEYS = ("last_cell", "steps_since_detection", "action_history")
_OF_ONE = "expected a task, a world or an environment of one target"


class ObservationVector(ObservationTransform):
    """Adds `observation` `[*B, M + (t_max+2) + (t_max+1) K]` float32: the one-hot cell and n, and the history's bits.

    ::

        env = TransformedEnv(TrackEnv(world, 64), Compose(ObservationVector(), ObservationNorm(...), StepCounter()))
        vector = ObservationVector(world)(TensorDict(...))["observation"]

    The keys of `TrackEnv` are numbers of cells and steps without a feature dimension, on which `CatTensors`,
    `ObservationNorm`, `CatFrames` or a plain MLP make no sense; on `observation` they do.

    Args:
        task: a task or world, to be called without an environment; inside one it is taken from the specs.
        out_key: name of the vector.

    Raises:
        UserError: there are several targets; or when called, without a task and without an environment.
    """

    def __init__(self, task: Task | None = None, *, out_key: str = "observation") -> None:
        super().__init__(in_keys=list(_KEYS), out_keys=[out_key])
        self._sizes: tuple[int, int] | None = None
        if task is not None:
            self.fit(task)

    def fit(self, task: Task) -> None:
        """Take the numbers of cells and of values of n from a task, unless they are known."""
        if not isinstance(task, Task):
            raise UserError(f"ObservationVector: a {type(task).__name__}, {_OF_ONE}")
        self._sizes = self._sizes or (task.num_cells, task.t_max + 2)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """The specs of `TrackEnv` and of the vector."""
        if "present" in observation_spec.keys():  # noqa: SIM118 (no dict)
            raise UserError(f"ObservationVector: several targets, {_OF_ONE}")
        cell, n, history = (observation_spec[key] for key in _KEYS)
        self._sizes = (cell.space.n, n.space.n)
        width = sum(self._sizes) + history.shape[-2:].numel()
        shape = (*observation_spec.shape, width)
        observation_spec[self.out_keys[0]] = Bounded(
            0.0, 1.0, shape, dtype=torch.float32, device=observation_spec.device
        )
        return observation_spec

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._sizes is None and self.parent is not None:
            self.transform_observation_spec(self.parent.observation_spec.clone())
        if self._sizes is None:
            raise UserError("ObservationVector: without an environment, expected a world")
        cell, n, history = (next_tensordict[key] for key in _KEYS)
        parts = [one_hot(value, size) for value, size in zip((cell, n), self._sizes, strict=True)]
        vector = torch.cat([*parts, history.flatten(-2)], dim=-1).float()
        return next_tensordict.set(self.out_keys[0], vector)

    forward = _call

    def _reset(
        self,
        tensordict: TensorDictBase,  # noqa: ARG002
        tensordict_reset: TensorDictBase,
    ) -> TensorDictBase:
        return self._call(tensordict_reset)
