"""The possible positions after each move from each located cell: the ground on which chains of sets are searched.

Layer t holds one entry per pair (located cell x, cell j reachable from x in t moves), so that work on all located
cells at once is a few sparse products whose cost follows the support of the kernel, not M².
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.solvers.renewal import IndexArray, row_index
from trackmdp.world.model import BoolArray, World

__all__ = ["Layer", "build", "sets_to_chains", "chains_to_sets"]


@dataclass(frozen=True)
class Layer:
    """The entries after t moves.

    Attributes:
        rows, cells: `[E]`, located cell and possible position of each entry.
        moves: `[E_before, E]`, probability of moving from an entry of the layer before to one of this layer; in
            layer 0, where nothing has moved yet, the identity.
    """

    rows: IndexArray
    cells: IndexArray
    moves: sparse.csr_array


def build(world: World, length: int) -> list[Layer]:
    """Layers 0 ... `length`, all located cells together."""
    m = world.num_cells
    rows = cells = np.arange(m)
    layers = [Layer(rows, cells, sparse.eye_array(m, format="csr"))]
    for _ in range(length):
        step = world.kernel[cells]
        origin = row_index(step)
        keys, target = np.unique(rows[origin] * m + step.indices, return_inverse=True)
        moves = sparse.csr_array((step.data, target, step.indptr), shape=(len(rows), len(keys)))
        rows, cells = np.divmod(keys, m)
        layers.append(Layer(rows, cells, moves))
    return layers


def sets_to_chains(world: World, layers: list[Layer], sets: list[BoolArray]) -> BoolArray:
    """`[M, t_max + 1, M]` chains from the sensed entries of layers 1 ... t_max + 1."""
    chains = np.zeros((world.num_cells, len(sets), world.num_cells), dtype=bool)
    for n, (layer, on) in enumerate(zip(layers[1:], sets, strict=True)):
        chains[layer.rows, n, layer.cells] = on
    return chains


def chains_to_sets(layers: list[Layer], chains: BoolArray) -> list[BoolArray]:
    """The sensed entries of layers 1 ... t_max + 1."""
    return [chains[layer.rows, n, layer.cells] for n, layer in enumerate(layers[1:])]
