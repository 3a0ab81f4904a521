"""One recorded episode of several targets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from tensordict import TensorDict

from trackmdp.episodes.episode import Episode, Floats, Integers, Recording, ends
from trackmdp.notebook.card import Card, decimal
from trackmdp.world.model import BoolArray, Task


@dataclass(frozen=True, eq=False, repr=False)
class GroupEpisode(Recording):
    """T steps of K targets that share the sensors. Row t is step t, as of `Episode`; column k is target k.

    Attributes:
        number: its place in the log.
        seed: all its draws derive from it, so that it replays alone.
        policy: which of the log's policies acted.
        start: `[K]` cells in which the targets were located at the start; M of one that enters later.
        misses: `[T, K]` n before the step, 0 once the target has left.
        action: `[T, S]` sensors on; none where the safe action is forced.
        target: `[T, K]` the true cells after the move, M before a target enters and once it has left the grid.
        located: `[T, K]` whether the target was located in that cell, as one that enters always is.
        reward: `[T]` reward of all targets together.
        terminated: the last target left in the last step.
        truncated: the last step was the last one allowed.
        belief: `[T · K, M]` sparse: row t · K + k has the probability of each cell for target k after the move, given
            all that was observed before it; a row sums to the probability that it has not left. None unless it was
            asked for.
    """

    number: int
    seed: int
    policy: int
    start: Integers
    misses: Integers
    action: BoolArray
    target: Integers
    located: BoolArray
    reward: Floats
    terminated: bool
    truncated: bool = False
    belief: sparse.csr_array | None = None
    first_tick: int | None = field(default=None)

    def card(self) -> Card:
        """Length, return, detections and end."""
        end = "all targets exited" if self.terminated else "truncated"
        facts = {"targets": str(len(self.start)), "steps": f"{len(self):,}; {end}"}
        facts["return"] = decimal(float(self.returns[-1]))
        facts["located"] = f"{int(self.located.sum()):,} times"
        facts["sensors per step"] = decimal(float(self.action.sum(1).mean()))
        return Card(f"Episode: number {self.number}, seed {self.seed}", facts)

    @property
    def complete(self) -> bool:
        """See `Recording`."""
        return self.belief is not None

    def singles(self) -> Iterator[Episode]:
        """See `Recording`."""
        targets = len(self.start)
        for k in range(targets):
            belief = None if self.belief is None else self.belief[k::targets].toarray()
            yield Episode(
                number=self.number,
                seed=self.seed,
                policy=self.policy,
                start=int(self.start[k]),
                misses=self.misses[:, k],
                action=self.action,
                target=self.target[:, k],
                located=self.located[:, k],
                reward=self.reward,
                terminated=self.terminated,
                truncated=self.truncated,
                belief=belief,
                probability=self.action.astype(np.float32),
            )

    def expected(self, t: int, cells: int) -> npt.NDArray[np.floating[Any]]:
        """See `Recording`."""
        if self.belief is None:
            return np.zeros(cells)
        rows = self.belief[t * len(self.start) : (t + 1) * len(self.start)]
        return np.asarray(rows.sum(axis=0), dtype=np.float64)

    def to_tensordict(self, task: Task) -> TensorDict:
        """`[T]` steps under the keys of `TrackEnv` for several targets, the outcome of each step under `next`."""
        gone, seen = (
            np.append(self.start[None], self.target, axis=0) >= task.num_cells,
            self.located,
        )
        misses = np.append(self.misses, np.where(seen[-1] | gone[-1], 0, self.misses[-1] + 1)[None])
        states: dict[str, npt.NDArray[Any]] = {
            "last_cell": np.where(self._last_cells < task.num_cells, self._last_cells, 0),
            "steps_since_detection": misses.reshape(gone.shape),
            "present": ~gone,
            "action_history": self._history(task.t_max),
        }
        if not task.available.all():
            states["action_mask"] = np.broadcast_to(task.available, (len(gone), len(task.cost)))
        if task.max_steps:
            states["step_count"] = np.arange(len(gone))
        current = {key: value[:-1] for key, value in states.items()}
        current |= {"action": self.action, **ends(len(self), terminated=False, truncated=False)}
        following = {key: value[1:] for key, value in states.items()}
        following |= {
            "reward": self.reward[:, None],
            **ends(len(self), self.terminated, self.truncated),
        }
        return TensorDict({**current, "next": following}, [len(self)])

    def _history(self, t_max: int) -> BoolArray:
        """`[T + 1, t_max + 1, S]` last actions in each state, the latest first; none from before a safe action."""
        late = np.any(self.misses > t_max, axis=1)
        # The state after the last safe action before it: with one at step 1 of four, 0 0 2 2 2.
        since = np.maximum.accumulate(np.append(0, np.where(late, np.arange(len(late)) + 1, 0)))
        step = np.arange(len(late) + 1)[:, None] - 1 - np.arange(t_max + 1)
        kept = step >= since[:, None]
        found: BoolArray = self.action[np.where(kept, step, 0)] & kept[..., None]
        return found
