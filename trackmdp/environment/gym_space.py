"""Gymnasium's spaces of sets of sensors within a budget, of one target and of a batch."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

Sets = npt.NDArray[np.int8]


class _Within:
    """Sets `[..., K]` of 0 and 1, of which at most `budget` are 1 in the last dimension."""

    budget: int
    np_random: np.random.Generator

    def sample(self, *args: Any, **kwargs: Any) -> Sets:
        """Random sets: `budget` sensors, uniformly chosen, each of which is on with probability 1/2."""
        bits: Sets = super().sample(*args, **kwargs)  # type: ignore[misc]  # of Gymnasium's own class
        return bits * (self.np_random.random(bits.shape).argsort(-1) < self.budget)

    def contains(self, x: Any) -> bool:
        """Whether `x` is such an array of sets."""
        return super().contains(x) and bool((np.sum(x, axis=-1) <= self.budget).all())  # type: ignore[misc]


class AtMost(_Within, spaces.MultiBinary):
    """Sets of at most `budget` of K sensors."""

    def __init__(self, sensors: int, budget: int) -> None:
        super().__init__(sensors)
        self.budget = budget


class _Batch(_Within, spaces.Box):
    """Sets `[B, K]`: a `Box`, as Gymnasium makes of a batch of a `MultiBinary`."""

    def __init__(self, space: AtMost, n: int) -> None:
        super().__init__(0, 1, (n, *space.shape), np.int8, deepcopy(space.np_random))
        self.budget = space.budget


batch_space.register(AtMost, _Batch)
