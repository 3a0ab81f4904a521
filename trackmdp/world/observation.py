"""What the tracker knows as one vector, for transforms and networks of everyday use."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import ObservationTransform

_KEYS = ("last_cell", "steps_since_detection", "action_history")


class ObservationVector(ObservationTransform):
    """Adds `observation` `[*B, M + (t_max+2) + (t_max+1) K]` float32: the one-hot cell and n, and the history's bits.

    ::

        env = TransformedEnv(TrackEnv(world, 64), Compose(ObservationVector(), ObservationNorm(...), StepCounter()))

    The keys of `TrackEnv` are numbers of cells and steps without a feature dimension, on which `CatTensors`,
    `ObservationNorm`, `CatFrames` or a plain MLP make no sense; on `observation` they do.
    """

    def __init__(self) -> None:
        super().__init__(in_keys=list(_KEYS), out_keys=["observation"])
        self._values: tuple[int, int] | None = None

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """The specs of `TrackEnv`, and that of the vector."""
        history = observation_spec["action_history"]
        width = sum(self._counted(observation_spec)) + history.shape[-2:].numel()
        shape = (*observation_spec.shape, width)
        observation_spec["observation"] = Bounded(0.0, 1.0, shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec

    def _counted(self, observation_spec: Composite) -> tuple[int, int]:
        """How many cells there are, and how many values of n."""
        if self._values is None:
            self._values = (observation_spec["last_cell"].space.n, observation_spec["steps_since_detection"].space.n)
        return self._values

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        sizes = self._values or self._counted(self.parent.observation_spec)
        cell, n, history = (next_tensordict[key] for key in _KEYS)
        parts: list[Tensor] = [one_hot(value, size) for value, size in zip((cell, n), sizes, strict=True)]
        return next_tensordict.set("observation", torch.cat([*parts, history.flatten(-2)], dim=-1).float())

    forward = _call

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)
