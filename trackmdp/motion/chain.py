"""The motion of a target as a chain of hidden states: of a model, or along recorded tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays.entries import row_sums

Indices = npt.NDArray[np.integer[Any]]


@dataclass(frozen=True, eq=False)
class Motion:
    """A Markov chain of Z hidden states; a detection shows the cell of the state.

    A state is the cell (the paper), a cell and a mode, or a point of a recorded track, which moves on to the next point
    with probability 1.

    Attributes:
        moves: `[Z, Z]` sub-stochastic CSR; a row sums to 1 less the probability of the exit.
        cell: `[Z]`, the cell of each state.
        first: `[F]`, states in which episodes start, each as likely.
        stay: `[Z]`, probability of still being in the grid after one move.
        modes: H; z % H is the mode of state z.
        ends: `[Z]`, whether a recording stops in a state, so that there is no further step; None: nowhere.
    """

    moves: sparse.csr_array
    cell: Indices
    first: Indices
    stay: npt.NDArray[np.float64]
    modes: int = 1
    ends: npt.NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, moves: sparse.csr_array, modes: int = 1) -> Motion:
        """The chain of (cell, mode), in each of which episodes start."""
        states = np.arange(moves.shape[0])
        return cls(moves, states // modes, states, row_sums(moves), modes)

    @property
    def num_states(self) -> int:
        """Z."""
        return int(self.moves.shape[0])

    def discounted(self, discount: float) -> Motion:
        """The motion with the factor γ on each move.

        All rewards of a step are weighted by the moves before it, so that every value comes out as γ times the
        discounted one, and r + V as r + γ V(discounted): the credit of a detection.
        """
        return replace(self, moves=self.moves * discount, stay=self.stay * discount)
