"""Draws of simulated episodes, each episode's from generators of its own, and their steps put in order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from trackmdp.arrays.types import AnyArray, IndexArray
from trackmdp.seeding import derive

Columns: TypeAlias = dict[str, AnyArray]

_BLOCK = 256  # draws taken from an episode's generator at a time; part of the meaning of a seed, so never to be changed


class Draws:
    """Draws of many episodes, each from a generator of its own, `_BLOCK` steps at a time.

    Args:
        seeds: of the episodes.
        draw: so many draws of a generator, `[count, ...]`.
        names: of the generators, derived from the seeds.
    """

    _block: Tensor

    def __init__(
        self, seeds: Sequence[int], draw: Callable[[int, torch.Generator], Tensor], *names: str
    ) -> None:
        # A generator for each episode, not one for the batch: its draws must not depend on how many others
        # run beside it, nor on when they end.
        seeds = [derive(seed, *names) for seed in seeds] if names else seeds
        self.generators, self._draw = [torch.Generator().manual_seed(seed) for seed in seeds], draw

    def at(self, row: Tensor, step: int) -> Tensor:
        """`[R, ...]`, those of the running episodes `row` `[R]` at their step."""
        place = step % _BLOCK
        # At steps 0, 256, 512, ...: all running episodes are at the same step, and refill together; ended ones draw no
        # more.
        if place == 0:
            drawn = torch.stack(
                [self._draw(_BLOCK, self.generators[each]) for each in row.tolist()]
            )
            if step:
                self._block[row] = drawn
            else:
                self._block = drawn
        return self._block[row, place]


def uniform(
    seeds: Sequence[int], name: str, *shape: int, dtype: torch.dtype = torch.float64
) -> Draws:
    """`[R, *shape]` uniform in [0, 1)."""
    return Draws(
        seeds, lambda count, rng: torch.rand(count, *shape, dtype=dtype, generator=rng), name
    )


def joined(taken: Sequence[Columns], episodes: int = 0) -> tuple[Columns, IndexArray]:
    """Columns of steps, taken together by the running episodes `row`, as one episode after another's; their lengths.

    Steps were taken in order of time; a stable sort by episode leaves them so within each. Example: the rows 0 1 2,
    then 0 2, then 2 (episode 1 ended first): the order is 0 3 1 2 4 5, the sorted rows are 0 0 1 2 2 2, the lengths 2 1
    3. The last ones of `episodes` may have no rows.
    """
    columns = {name: np.concatenate([step[name] for step in taken]) for name in taken[0]}
    row = columns.pop("row")
    order = np.argsort(row, kind="stable")
    lengths = np.bincount(row, minlength=episodes)
    return {name: column[order] for name, column in columns.items()}, lengths


def narrow(column: AnyArray) -> AnyArray:
    """A copy, since an expanded tensor has no memory of its own; cells and counts fit into 32 bits."""
    return column.astype(np.int32) if column.dtype == np.int64 else column.copy()
