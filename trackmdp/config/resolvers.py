"""The OmegaConf resolvers that `conf/` uses, ``${name:...}``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf


def register_resolvers() -> None:
    """Register `${first:a,b}` and `${per_cell:count,size}`, or `${per_cell:count,size,least}`."""
    # replace=True: resolvers are global to the process, and a second composing would otherwise fail on the first name.
    OmegaConf.register_new_resolver("first", _first_given, replace=True)
    OmegaConf.register_new_resolver("per_cell", _per_cell, replace=True)


def _first_given(*values: Any) -> Any:
    """The first value that is not null."""
    return next((value for value in values if value is not None), None)


def _per_cell(count: float, size: Any, least: int = 0) -> int:
    """`count` for each cell of a grid of N x N cells, or of [rows, columns]; `least` in all.

    A fraction gives a whole number of `least`: .2 for each of 100 x 100 cells in thousands are 2000, of 110 x 110 3000.
    """
    sides = (size, size) if isinstance(size, int) else size
    if not isinstance(sides, Sequence) or not all(isinstance(side, int) for side in sides):
        return max(math.ceil(count), least)  # such a size is refused when its own option is checked
    if isinstance(count, int):
        return max(count * math.prod(sides), least)
    # Rounded before it is rounded up: .2 · M / 1000 and M / 5000 have to agree, whatever the last bit.
    return max(math.ceil(round(count * math.prod(sides) / least, 9)), 1) * least
