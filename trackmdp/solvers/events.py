"""Events: where renewals begin, numbered.

An *event* is a pair (key, state) at a detection: the tracker's memory, and the hidden state of the target.
Events are a Markov chain, also where the key forgets: the key determines the sets, and the state the future of the
target. A safe action that misses is repeated, with D each time. So there are events of a second kind, the target
missed by it in a state: they begin at the last step, the next safe action.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trackmdp.arrays.types import IndexArray, Indices
from trackmdp.memory.keys import KeySpace
from trackmdp.motion.chain import Motion


@dataclass(frozen=True, eq=False)
class Events:
    """All events that can occur, in order of (state, key); then the events of missed safe actions.

    Attributes:
        keys: the key space.
        states: Z, of the motion.
        codes: `[B]` sorted numbers: state · keys + key, and Z · keys more for a missed safe action.
    """

    keys: KeySpace
    states: int
    codes: Indices

    @cached_property
    def forced(self) -> int:
        """Events of missed safe actions, the last ones."""
        return len(self.codes) - int(np.searchsorted(self.codes, self.states * self.keys.num_keys))

    @cached_property
    def key(self) -> IndexArray:
        """`[B]`."""
        return np.asarray(self.codes % self.keys.num_keys)

    @cached_property
    def state(self) -> IndexArray:
        """`[B]`."""
        return np.asarray(self.codes // self.keys.num_keys % self.states)

    @cached_property
    def complete(self) -> bool:
        """Whether the event of state z is event z: the key is a function of the state, and all states are there."""
        return self.keys.order == 0 and len(self.codes) == self.states * (1 + (self.forced > 0))


def detected_codes(keys: KeySpace, key: IndexArray, state: IndexArray) -> Indices:
    """`[E]`, see `Events`."""
    return state.astype(np.int64) * keys.num_keys + key


def started(keys: KeySpace, motion: Motion, state: IndexArray) -> Indices:
    """`[E]` codes of detections in these states at an episode's start."""
    return detected_codes(keys, keys.start(motion.cell[state], state % motion.modes), state)


def forced_codes(keys: KeySpace, states: int, key: IndexArray, state: IndexArray) -> Indices:
    """`[E]`, see `Events`; what the next key does not depend on counts as 0."""
    if keys.order < 2:  # the next one depends on the last located cell at most
        key = keys.start(keys.cell(key)) if keys.order else 0 * key
    return detected_codes(keys, key, state.astype(np.int64) + states)
