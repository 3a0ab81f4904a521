"""Where one target may be: the exact belief filter, step by step, in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackmdp.errors import UserError
from trackmdp.world.model import Array


class Belief:
    """Probability of each hidden state of a target that is known to be in the grid.

    State z is cell z // H and mode z % H, with H modes.

    Args:
        world: its motion.
        cell: in which it was located.
        mode: its mode there, where a detection gives it; None: all are equally likely.

    Attributes:
        states: `[Z]`, of sum 1.
    """

    states: Array

    def __init__(self, world: Any, cell: int, mode: int | None) -> None:
        self._into = world.kernel.T.tocsr()  # entry (y, x): from x into y
        self._modes = world.kernel.shape[0] // world.num_cells
        self.states = self._mask(cell, mode) / self._mask(cell, mode).sum()

    @property
    def cells(self) -> Array:
        """`[M]` probability of each cell."""
        return self.states.reshape(-1, self._modes).sum(axis=1)

    def restore(self, states: Any) -> None:
        """Go on from the `states` of an earlier belief, as a list.

        Raises:
            UserError: they are not as many probabilities.
        """
        found = np.array(states if isinstance(states, list) else [], dtype=np.float64)
        if found.shape != self.states.shape or not (found >= 0).all() or not 0 < found.sum() < 1.1:
            raise UserError(f"state: belief, expected {len(self.states)} probabilities")
        self.states = found

    def missed(self, reported: Array) -> None:
        """A move without a report; `reported` `[M]` is the probability of a report from each cell."""
        moved = self._into @ self.states
        self._condition(moved * (1.0 - np.repeat(reported, self._modes)), moved)

    def located(self, cell: int, mode: int | None) -> None:
        """A move into a cell, in which the target was located."""
        mask = self._mask(cell, mode)
        self._condition((self._into @ self.states) * mask, mask)

    def _condition(self, weight: Array, otherwise: Array) -> None:
        """Scale to sum 1; where the observation cannot have happened, the fallback stands in."""
        chosen = weight if weight.sum() > 0 else otherwise
        self.states = chosen / chosen.sum()

    def _mask(self, cell: int, mode: int | None) -> Array:
        """`[Z]` 1 in the states of a cell, or in the one of cell and mode."""
        mask = np.zeros(self._into.shape[0])
        begin = cell * self._modes
        mask[begin : begin + self._modes] = mode is None
        if mode is not None:
            mask[begin + mode] = 1.0
        return mask
