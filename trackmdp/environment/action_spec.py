"""The spec of sets of sensors within a budget."""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import torch
from torch import Tensor
from torchrl.data import Binary


class _AtMost(Binary):
    """Bits `[..., sensors]`, of which at most `budget` are 1 in the last dimension.

    Each budget has a class of its own (`at_most`), since TorchRL makes new specs of old ones by
    `self.__class__(n, shape, device, dtype)`. Where the last dimension is another, sets have no place of their own, and
    a `Binary` is made.
    """

    budget: ClassVar[int]
    sensors: ClassVar[int]

    def __new__(cls, n: int | None = None, shape: Any = None, **kwargs: Any) -> Any:
        if tuple(shape)[-1:] == (cls.sensors,):
            return super().__new__(cls)
        return Binary(n, shape, **kwargs)

    @classmethod
    def __subclasshook__(cls, other: type) -> bool:
        """`torch.stack` joins specs if each is an instance of the first one's class: all binary ones count as such."""
        return Binary in other.__mro__  # `issubclass` would ask here again

    def rand(self, shape: Any = None) -> Tensor:
        """Random sets: `budget` sensors, uniformly chosen, each of which is on with probability 1/2."""
        bits = super().rand(shape)
        return bits * (torch.rand(bits.shape, device=bits.device).argsort(-1) < self.budget)

    def is_in(self, val: Tensor) -> bool:
        """Whether `val` has the spec's shape, dtype and values, and keeps to the budget."""
        return bool(super().is_in(val) and (val.sum(-1) <= self.budget).all())

    def _project(self, val: Tensor) -> Tensor:
        """Of the sensors that are on the first `budget`."""
        bits = val if val.dtype == torch.bool else super()._project(val)
        return bits * (bits.cumsum(-1) <= self.budget)

    def __reduce__(self) -> tuple[Any, ...]:
        return _blank, (self.budget, self.sensors), self.__getstate__()


@cache
def at_most(budget: int | None, sensors: int) -> type[Binary]:
    """The class of specs of sets of at most `budget` of so many sensors; made with a `shape`, as a `Binary` is.

    That is `Binary` itself where all may be on.
    """
    if budget is None or budget >= sensors:
        return Binary
    members = {"budget": budget, "sensors": sensors, "__module__": __name__}
    return type(f"AtMost{budget}", (_AtMost,), members)


def _blank(budget: int, sensors: int) -> Binary:
    """A spec before its attributes are set, for pickle, which finds no class that was made by a call."""
    return object.__new__(at_most(budget, sensors))
