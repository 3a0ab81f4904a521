"""Prior mean gains of keys that were seldom seen, or never."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.algos.estimates.path_gains import Paths
from trackmdp.arrays.entries import summing
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.memory.keys import KeySpace

_LIFTED = 30.0
"""A cell's lift is drawn to 1 as if prior² / 30 more detections had been expected, and made; times the copies of each
path. Where cells have few detections, and large weights serve best, the moves on a few tracks would else count for all
keys of a cell: on storms that costs more than it gains, in a city it gains (chosen by validation tracks of both)."""
_LITTLE = 1e-9
"""Smallest prior weight, so that unseen keys fall back on their class even with `prior=0`."""


@dataclass(frozen=True)
class PriorMeans:
    """Prior mean gain of a key: the mean of its class times the lift of its cell.

    Were the cell and the class of a displacement independent given where the target goes, its chance would be that
    after the class, times the lift of the cell: chance from this cell over chance from anywhere; and divided by the sum
    of all such. Gains stand for chances here.

    Attributes:
        keys: how they are numbered.
        common: `[C, W]` (or `[1, W]`, where the cell alone is remembered) mean gains after each class.
        row: `[M]` of each cell in `lift`.
        lift: `[R, W]`, the last row for cells never seen, all 1.
        scale: `[R, C]`, so that the gains of all displacements together are lifted as those from the cell are.
    """

    keys: KeySpace
    common: Array
    row: IndexArray
    lift: Array
    scale: Array

    @classmethod
    def of(
        cls, paths: Paths, common: Array, own: sparse.csr_array, arrived: Array, prior: float
    ) -> PriorMeans:
        """By counts of the keys seen: gains `[K, W]` and arrivals."""
        task, seen = paths.task, paths.keys
        keys, row = task.keys, np.zeros(task.num_cells, np.int64)
        if keys.num_classes == 1:  # a key is its cell, and has the same counts
            return cls(keys, common, row, np.ones_like(common), np.ones((1, 1)))
        cells, of_key = np.unique(keys.cell(seen), return_inverse=True)
        together = summing(of_key, len(cells))
        gains, weight = np.maximum((together @ own).toarray(), 0.0), together @ arrived
        # Poisson counts with a gamma prior on the lift (DuMouchel 1999): a rare displacement that was seen once is no
        # lift of a hundred, as it would be were chances smoothed before they are divided.
        prior = task.reward * max(prior**2 / (_LIFTED * paths.copies), _LITTLE)
        chance = weight[:, None] * (gains.sum(0) / max(weight.sum(), 1e-12))
        lift = (gains + prior) / (chance + prior)
        common = np.maximum(common, 0.0)
        total = ((gains.sum(1) + prior) / (chance.sum(1) + prior))[:, None] * common.sum(1)
        product = lift @ common.T
        scale = np.divide(total, product, out=np.zeros_like(product), where=product > 0)
        row[:] = len(cells)
        row[cells] = np.arange(len(cells))
        lift, scale = (
            np.append(each, np.ones((1, each.shape[1])), axis=0) for each in (lift, scale)
        )
        return cls(keys, common, row, lift, scale)

    @property
    def most(self) -> Array:
        """`[C, W]`, no less than is expected from any cell."""
        return self.common * self.lift.max(0) * self.scale.max(0)[:, None]

    def after(self, keys: IndexArray, local: IndexArray) -> Array:
        """`[B, W]` gains of displacements `local` `[W]` after `keys` `[B]`."""
        # Each row of the lift once with each class: most cells are never seen, and all those have the last one.
        classes = self.keys.num_classes
        pairs = self.row[self.keys.cell(keys)] * classes + keys % classes
        pairs, place = np.unique(pairs, return_inverse=True)
        row, known = np.divmod(pairs, classes)
        gains = self.common[known[:, None], local] * self.lift[row[:, None], local]
        return (gains * self.scale[row, known][:, None])[place]
