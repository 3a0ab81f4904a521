"""One recorded episode, and the same as a TensorDict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict

from trackmdp.arrays.types import AnyArray, Array, BoolArray, Indices
from trackmdp.memory.keys import KeySpace
from trackmdp.notebook.card import Card, Carded, Facts, decimal
from trackmdp.sensing.actions import ActionMask
from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

Floats: TypeAlias = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Carded):
    """T steps of one target or of K. Row t is step t: state and action before the move, outcome after it.

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
        belief: probability of each cell after the move, given all that was observed before it; None unless it was
            asked for.
        mode: `[T]` the target's mode after the move, -1 once exited; None where targets have none.
        first_tick: place of its first step on the log's time line; None until it is logged.
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

    def __len__(self) -> int:
        return len(self.target)

    @cached_property
    def observation(self) -> Indices:
        """`[T]` the cell in which the target was located by the step, -1 if in none; of K targets `[T, K]`."""
        return np.where(self.located, self.target, -1)

    @property
    def last_cell(self) -> Indices:
        """`[T]` cell of the last detection before the step, x_{l(k)}; of K targets `[T, K]`."""
        return self._last_cells[:-1]

    @cached_property
    def _last_cells(self) -> Indices:
        """`[T + 1]`, also after the last step."""
        return last_cells(self.start, self.target, self.located)

    @cached_property
    def returns(self) -> Array:
        """`[T]` reward summed up to and with the step."""
        return np.cumsum(self.reward, dtype=np.float64)

    def forced(self, t_max: int) -> BoolArray:
        """`[T]` whether the safe action replaced the chosen one."""
        late = self.misses > t_max
        found: BoolArray = late if late.ndim == 1 else np.any(late, axis=1)
        found[-1] &= not self.terminated  # the last step is the exit's
        return found

    def singles(self) -> Iterator[Episode]:
        """An episode for each target, with the sensors and the reward of all."""
        raise NotImplementedError

    def expected(self, t: int) -> AnyArray:
        """`[M]` how many targets were expected in each cell at step `t`; beliefs were asked for."""
        raise NotImplementedError

    def to_tensordict(self, task: Task) -> TensorDict:
        """`[T]` steps under the keys of `TrackEnv`, as a rollout has them: the outcome of each step under `next`.

        As in a rollout the true cell is not among them; it is `target`. With `max_steps` there is a `step_count`.
        """
        raise NotImplementedError

    def _card(self, facts: Facts, located: str) -> Card:
        """A card that begins with `facts`."""
        facts |= {"return": decimal(float(self.returns[-1])), "located": located}
        facts["sensors per step"] = decimal(float(self.action.sum(1).mean()))
        return Card(f"Episode: number {self.number}, seed {self.seed}", facts)

    def _transitions(
        self, task: Task, states: dict[str, AnyArray], action: BoolArray
    ) -> TensorDict:
        """See `to_tensordict`; of the T + 1 `states` the last has no action, and the first is no outcome."""
        if task.max_steps:
            states["step_count"] = np.arange(len(self) + 1)
        current = {key: value[:-1] for key, value in states.items()}
        following = {key: value[1:] for key, value in states.items()}
        following["reward"] = self.reward[:, None]
        for part, terminated, truncated in (
            (current, False, False),
            (following, self.terminated, self.truncated),
        ):
            part |= ends(len(self), terminated, truncated)
        return TensorDict({**current, "action": action, "next": following}, [len(self)])


@dataclass(frozen=True, eq=False, repr=False)
class Episode(Recording):
    """Steps of one target; see `Recording`.

    Attributes:
        belief: `[T, M]`; a row sums to the probability of no exit.
        probability: `[T, M]` with which the policy sensed each cell. None unless it was asked for.
        start_mode: the target's mode at the start; 0 where targets have none.
    """

    start: int
    probability: Any = None
    start_mode: int = 0

    def card(self) -> Card:
        """Length, return, detections and end."""
        end = "the target exited" if self.terminated else "truncated"
        facts = {"steps": f"{len(self):,}; {end}", "start": f"cell {self.start}"}
        return self._card(facts, f"in {int(self.located.sum()):,} steps")

    def singles(self) -> Iterator[Episode]:
        """See `Recording`."""
        yield self

    def expected(self, t: int) -> AnyArray:
        """See `Recording`."""
        return self.belief[t]

    def to_tensordict(self, task: Task) -> TensorDict:
        """See `Recording`; with a window actions are in its local numbers, as the environment takes them."""
        action = (
            Window.of(task)
            .to_local(torch.from_numpy(self.last_cell), torch.from_numpy(self.action))
            .numpy()
        )
        over = self.located[-1] or self.terminated
        misses = np.append(self.misses, 0 if over else min(self.misses[-1] + 1, task.t_max + 1))
        states = {
            "last_cell": self._last_cells,
            "steps_since_detection": misses,
            "action_history": _history(action, misses, self.located, task.t_max),
        }
        if task.keyed:
            states["key"] = self._keys(task.keys)
        if (mask := ActionMask(task)).observed:
            states["action_mask"] = mask(torch.from_numpy(self._last_cells)).numpy()
        return self._transitions(task, states, action)

    def _keys(self, keys: KeySpace) -> Indices:
        """`[T + 1]` the memory in each state."""
        found = [np.int64(keys.start(self.start, self.start_mode))]
        mode = 0 * self.target if self.mode is None else self.mode
        for each in zip(self.located, self.misses, self.target, mode, strict=True):
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


def last_cells(start: Any, target: Indices, located: BoolArray) -> Indices:
    """`[T + 1]` cell of the last detection before each step of an episode, and after the last one; or `[T + 1, K]`.

    With detections at steps 1 and 3 of five, `latest` is -1 -1 1 1 3 3.
    """
    found = np.where(located.T, np.arange(len(target)), -1).T
    # Shifted by one: a detection is known from the next step on.
    latest = np.insert(np.maximum.accumulate(found), 0, -1, axis=0)
    return np.where(latest < 0, start, np.take_along_axis(target, latest, axis=0))


def ends(steps: int, terminated: bool, truncated: bool) -> dict[str, Any]:
    """The flags `done`, `terminated` and `truncated` `[T, 1]` of an episode of T steps."""
    flags = {name: np.zeros((steps, 1), dtype=bool) for name in ("done", "terminated", "truncated")}
    for name, value in (
        ("terminated", terminated),
        ("truncated", truncated),
        ("done", terminated or truncated),
    ):
        flags[name][-1] = value
    return flags


SCALARS = ("seed", "policy", "start", "start_mode", "terminated", "truncated")
PER_STEP = ("target", "mode", "misses", "action", "located", "reward", "probability", "belief")


def first_difference(
    logged: Recording, again: Recording, *, belief_tolerance: float = 0.0
) -> str | None:
    """Where two recordings of an episode part, in words; None where every bit is the same.

    Args:
        logged: one of them.
        again: the other.
        belief_tolerance: differences of the belief up to this one pass.
    """
    pairs = enumerate(zip(logged.singles(), again.singles(), strict=True))
    found = {k: _first(mine, other, belief_tolerance) for k, (mine, other) in pairs}
    several = len(found) > 1
    said = (f"target {k}, {each}" if several else each for k, each in found.items() if each)
    return next(said, None)


def _first(logged: Episode, again: Episode, belief_tolerance: float) -> str | None:
    """See `first_difference`; of one target."""
    for name in SCALARS:
        mine, other = getattr(logged, name), getattr(again, name)
        if mine != other:
            return f"{name}: logged {mine}, re-simulated {other}"
    steps = min(len(logged), len(again))
    known = [name for name in PER_STEP if name != "mode" or logged.mode is not None]
    found = [_differing(logged, again, name, steps, belief_tolerance) for name in known]
    if apart := list(filter(None, found)):
        step, how = min(apart, key=lambda each: each[0])
        return f"step {step}, {how}"
    if len(logged) != len(again):
        return f"length: logged {len(logged)} steps, re-simulated {len(again)}"
    return None


def _differing(
    logged: Episode, again: Episode, name: str, steps: int, tolerance: float
) -> tuple[int, str] | None:
    """The first step at which the arrays called `name` differ, and how."""
    mine, other = getattr(logged, name)[:steps], getattr(again, name)[:steps]
    differs = mine != other
    if name == "belief" and tolerance:
        differs = ~(np.abs(mine - other) <= tolerance)  # so that a NaN differs from every number
    if not differs.any():
        return None
    where = tuple(int(each) for each in np.argwhere(differs)[0])
    cell = f" of cell {where[1]}" if len(where) > 1 else ""
    return where[0], f"{name}{cell}: logged {mine[where]}, re-simulated {other[where]}"
