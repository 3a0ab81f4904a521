"""One recorded episode, and the same as a TensorDict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict

from trackmdp.arrays.types import AnyArray, Array, BoolArray, Indices
from trackmdp.memory.keys import KeySpace
from trackmdp.notebook.card import Card, Carded, decimal
from trackmdp.sensing.actions import ActionMask
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

Floats: TypeAlias = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class Episode(Carded):
    """T steps of one target, or of K that share the sensors, column k of target k.

    Row t is step t: state and action before the move, outcome after it.

    Attributes:
        number: its place in the log.
        seed: all its draws derive from it, so that it replays alone.
        policy: which of the log's policies acted.
        start: cell in which the target was located at the start; of K targets `[K]`, M of one that enters later.
        misses: `[T]` n before the step; `[T, K]`, 0 once a target has left.
        action: `[T, S]` sensors on; where the safe action is forced (n > t_max) it counts for nothing.
        target: `[T]` the true cell after the move, M once exited; `[T, K]`, M also before a target enters.
        located: `[T]` or `[T, K]` whether the target was located in that cell, as one that enters always is.
        reward: `[T]` reward of the step, of all targets together.
        terminated: the target, or the last one, exited in the last step.
        truncated: the last step was the last one allowed.
        belief: `[T, M]` probability of each cell after the move, given all that was observed before it; a row sums to
            the probability of no exit. Of K targets `[T · K, M]` sparse, row t · K + k of target k. None unless it was
            asked for.
        mode: `[T]` the target's mode after the move, -1 once exited; `[T, K]`; None where targets have none.
        first_tick: place of its first step on the log's time line; None until it is logged.
        probability: `[T, M]` with which the policy sensed each cell. None unless it was asked for, and of K targets.
        start_mode: the target's mode at the start; of K targets `[K]`; 0 where targets have none.
    """

    number: int
    seed: int
    policy: int
    start: Any
    misses: Indices
    action: BoolArray
    target: Indices
    located: BoolArray
    reward: Floats
    terminated: bool
    truncated: bool = False
    belief: Any = None
    mode: Indices | None = None
    first_tick: int | None = None
    probability: Any = None
    start_mode: Any = 0

    def __len__(self) -> int:
        return len(self.target)

    @property
    def several(self) -> bool:
        """Whether it is of K targets."""
        return self.target.ndim > 1

    @cached_property
    def observation(self) -> Indices:
        """`[T]` the cell in which the target was located by the step, -1 if in none; of K targets `[T, K]`."""
        return np.where(self.located, self.target, -1)

    @property
    def last_cell(self) -> Indices:
        """`[T]` cell of the last detection before the step, x_{l(k)}; of K targets `[T, K]`."""
        return last_cells(self.start, self.target, self.located)[:-1]

    @cached_property
    def returns(self) -> Array:
        """`[T]` reward summed up to and with the step."""
        return np.cumsum(self.reward, dtype=np.float64)

    def forced(self, t_max: int) -> BoolArray:
        """`[T]` whether the safe action replaced the chosen one."""
        late = self.misses > t_max
        found: BoolArray = np.any(late, axis=1) if self.several else late
        found[-1] &= not self.terminated  # the last step is the exit's
        return found

    def singles(self) -> Iterator[Episode]:
        """An episode for each target, with the sensors and the reward of all."""
        if not self.several:
            yield self
            return
        names = ("misses", "target", "located") + (() if self.mode is None else ("mode",))
        modes = np.broadcast_to(self.start_mode, self.start.shape).tolist()
        for k, start in enumerate(self.start):
            columns = {name: getattr(self, name)[:, k] for name in names}
            belief = None if self.belief is None else self.belief[k :: len(self.start)].toarray()
            probability = self.action.astype(np.float32)
            begun = {"start": int(start), "start_mode": modes[k]}
            yield replace(self, belief=belief, probability=probability, **begun, **columns)

    def expected(self, t: int) -> AnyArray:
        """`[M]` how many targets were expected in each cell at step `t`; beliefs were asked for."""
        if not self.several:
            return self.belief[t]
        rows = self.belief[t * len(self.start) : (t + 1) * len(self.start)]
        return np.asarray(rows.sum(axis=0), np.float64)

    def to_tensordict(self, task: Task) -> TensorDict:
        """`[T]` steps under the keys of `TrackEnv`, as a rollout has them: the outcome of each step under `next`.

        As in a rollout the true cell is not among them; it is `target`. With a window actions are in its local numbers,
        as the environment takes them. With `max_steps` there is a `step_count`.
        """
        states, action = (_of_several if self.several else _of_one)(self, task)
        if task.max_steps:
            states["step_count"] = np.arange(len(self) + 1)
        # Of the T + 1 states the last has no action, and the first is no outcome.
        current = {key: value[:-1] for key, value in states.items()}
        following = {key: value[1:] for key, value in states.items()}
        following["reward"] = self.reward[:, None]
        current |= _ends(len(self), False, False)
        following |= _ends(len(self), self.terminated, self.truncated)
        return TensorDict({**current, "action": action, "next": following}, [len(self)])

    def card(self) -> Card:
        """Length, return, detections and end; sensors are counted where T_max is known (`Episodes.figures`)."""
        who = "all targets" if self.several else "the target"
        end, count = f"{who} exited" if self.terminated else "truncated", int(self.located.sum())
        facts = {"targets": str(len(self.start))} if self.several else {}
        facts["steps"] = f"{len(self):,}; {end}"
        if not self.several:
            facts["start"] = f"cell {self.start}"
        facts["return"] = decimal(float(self.returns[-1]))
        facts["located"] = f"{count:,} times" if self.several else f"in {count:,} steps"
        return Card(f"Episode: number {self.number}, seed {self.seed}", facts)


def _of_one(episode: Episode, task: Task) -> tuple[dict[str, AnyArray], BoolArray]:
    """States `[T + 1, ...]` and actions of one target."""
    cells = last_cells(episode.start, episode.target, episode.located)
    action = (
        Window.of(task)
        .to_local(torch.from_numpy(cells[:-1]), torch.from_numpy(episode.action))
        .numpy()
    )
    over = episode.located[-1] or episode.terminated
    misses = np.append(episode.misses, 0 if over else min(episode.misses[-1] + 1, task.t_max + 1))
    states = {
        "last_cell": cells,
        "steps_since_detection": misses,
        "action_history": _history(action, misses, episode.located, task.t_max),
    }
    if task.keyed:
        states["key"] = _keys(episode, task.keys)
    if (mask := ActionMask(task)).observed:
        states["action_mask"] = mask(torch.from_numpy(cells)).numpy()
    return states, action


def _keys(episode: Episode, keys: KeySpace) -> Indices:
    """`[T + 1]` the memory in each state."""
    found = [np.int64(keys.start(episode.start, episode.start_mode))]
    mode = 0 * episode.target if episode.mode is None else episode.mode
    for each in zip(episode.located, episode.misses, episode.target, mode, strict=True):
        found.append(keys.next(found[-1], *each[1:]) if each[0] else found[-1])
    return np.array(found)


def _history(action: BoolArray, misses: Indices, located: BoolArray, t_max: int) -> BoolArray:
    """`[T+1, t_max+1, K]` h in each state: slot s holds the action at s misses, empty from slot n on.

    That is the action of the s-th step after the last detection, from 0 on; the safe action, however often it is
    repeated, comes behind all slots.
    """
    # Example: misses 0 1 2 0 (located by the third step), t_max = 2. In state 2, n = 2: slot 0 is the action of step 0,
    # slot 1 the action of step 1, slot 2 is empty.
    slots = np.arange(t_max + 1)
    begin = np.where(located, np.arange(len(located)) + 1, 0)
    steps = np.concatenate([[0], np.maximum.accumulate(begin)])[:, None] + slots
    filled = slots < misses[:, None]
    # Empty slots would point at other steps: they read step 0 instead, and the mask clears the result.
    return action[np.where(filled, steps, 0)] & filled[..., None]


def _of_several(episode: Episode, task: Task) -> tuple[dict[str, AnyArray], BoolArray]:
    """States `[T + 1, ...]` and actions of several targets."""
    gone = np.append(episode.start[None], episode.target, axis=0) >= task.num_cells
    cells = last_cells(episode.start, episode.target, episode.located)
    more = np.minimum(episode.misses[-1] + 1, task.t_max + 1)
    last = np.where(episode.located[-1] | gone[-1], 0, more)
    states: dict[str, AnyArray] = {
        "last_cell": np.where(cells < task.num_cells, cells, 0),
        "steps_since_detection": np.append(episode.misses, last[None], axis=0),
        "present": ~gone,
        "action_history": _last_actions(episode, task.t_max),
    }
    if not task.available.all():
        states["action_mask"] = np.broadcast_to(task.available, (len(gone), len(task.cost)))
    return states, episode.action


def _last_actions(episode: Episode, t_max: int) -> BoolArray:
    """`[T + 1, t_max + 1, S]` last actions in each state, the latest first; none from before a safe action."""
    late = np.any(episode.misses > t_max, axis=1)
    # The state after the last safe action before it: with one at step 1 of four, 0 0 2 2 2.
    since = np.maximum.accumulate(np.append(0, np.where(late, np.arange(len(late)) + 1, 0)))
    step = np.arange(len(late) + 1)[:, None] - 1 - np.arange(t_max + 1)
    kept = step >= since[:, None]
    return episode.action[np.where(kept, step, 0)] & kept[..., None]


def last_cells(start: Any, target: Indices, located: BoolArray) -> Indices:
    """`[T + 1]` cell of the last detection before each step of an episode, and after the last one; or `[T + 1, K]`.

    With detections at steps 1 and 3 of five, `latest` is -1 -1 1 1 3 3.
    """
    found = np.where(located.T, np.arange(len(target)), -1).T
    # Shifted by one: a detection is known from the next step on.
    latest = np.insert(np.maximum.accumulate(found), 0, -1, axis=0)
    return np.where(latest < 0, start, np.take_along_axis(target, latest, axis=0))


def _ends(steps: int, terminated: bool, truncated: bool) -> dict[str, Any]:
    """The flags `done`, `terminated` and `truncated` `[T, 1]` of an episode of T steps."""
    last, over = np.arange(steps)[:, None] == steps - 1, terminated or truncated
    return {"done": last & over, "terminated": last & terminated, "truncated": last & truncated}
