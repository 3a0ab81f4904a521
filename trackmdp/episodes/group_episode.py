"""One recorded episode of several targets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from tensordict import TensorDict

from trackmdp.arrays.types import AnyArray, BoolArray, Indices
from trackmdp.episodes.episode import Episode, Recording
from trackmdp.notebook.card import Card
from trackmdp.sensing.task import Task


@dataclass(frozen=True, eq=False, repr=False)
class GroupEpisode(Recording):
    """Steps of K targets that share the sensors, column k of target k; see `Recording`.

    Attributes:
        belief: `[T · K, M]` sparse: row t · K + k is of target k; it sums to the probability that it has not left.
    """

    start: Indices

    def card(self) -> Card:
        """Length, return, detections and end."""
        end = "all targets exited" if self.terminated else "truncated"
        facts = {"targets": str(len(self.start)), "steps": f"{len(self):,}; {end}"}
        return self._card(facts, f"{int(self.located.sum()):,} times")

    def singles(self) -> Iterator[Episode]:
        """See `Recording`."""
        targets = len(self.start)
        shared = ("number", "seed", "policy", "action", "reward", "terminated", "truncated")
        for k in range(targets):
            yield Episode(
                **{name: getattr(self, name) for name in shared},
                **{name: getattr(self, name)[:, k] for name in ("misses", "target", "located")},
                start=int(self.start[k]),
                belief=None if self.belief is None else self.belief[k::targets].toarray(),
                probability=self.action.astype(np.float32),
            )

    def expected(self, t: int) -> AnyArray:
        """See `Recording`."""
        rows = self.belief[t * len(self.start) : (t + 1) * len(self.start)]
        return np.asarray(rows.sum(axis=0), dtype=np.float64)

    def to_tensordict(self, task: Task) -> TensorDict:
        """See `Recording`."""
        gone = np.append(self.start[None], self.target, axis=0) >= task.num_cells
        seen = self.located
        more = np.minimum(self.misses[-1] + 1, task.t_max + 1)
        misses = np.append(self.misses, np.where(seen[-1] | gone[-1], 0, more)[None])
        states: dict[str, AnyArray] = {
            "last_cell": np.where(self._last_cells < task.num_cells, self._last_cells, 0),
            "steps_since_detection": misses.reshape(gone.shape),
            "present": ~gone,
            "action_history": self._history(task.t_max),
        }
        if not task.available.all():
            states["action_mask"] = np.broadcast_to(task.available, (len(gone), len(task.cost)))
        return self._transitions(task, states, self.action)

    def _history(self, t_max: int) -> BoolArray:
        """`[T + 1, t_max + 1, S]` last actions in each state, the latest first; none from before a safe action."""
        late = np.any(self.misses > t_max, axis=1)
        # The state after the last safe action before it: with one at step 1 of four, 0 0 2 2 2.
        since = np.maximum.accumulate(np.append(0, np.where(late, np.arange(len(late)) + 1, 0)))
        step = np.arange(len(late) + 1)[:, None] - 1 - np.arange(t_max + 1)
        kept = step >= since[:, None]
        return self.action[np.where(kept, step, 0)] & kept[..., None]
