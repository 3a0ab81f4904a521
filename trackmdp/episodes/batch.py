"""Simulated episodes as a few columns with the steps of all, from which an `Episode` is made on request."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast, overload

import numpy as np
import numpy.typing as npt
import torch
from tensordict import TensorDict
from torch import Tensor

from trackmdp.arrays.types import BoolArray, Indices
from trackmdp.durable import write_text
from trackmdp.episodes.belief_filter import beliefs
from trackmdp.episodes.episode import Episode, Floats
from trackmdp.episodes.episode_draws import Columns
from trackmdp.episodes.grids import check_layers
from trackmdp.episodes.simulated_figures import Simulation, mean_ratio
from trackmdp.errors import UserError, output_of
from trackmdp.notebook.card import Card, Carded, decimal, grid_words, percent
from trackmdp.policies.policy import Policy
from trackmdp.solvers.several.merging import Rule
from trackmdp.world.group import Subject

_BELIEF = 25_600  # cells, or hidden states, of the beliefs updated together: memory stays bounded on large grids
_NUMBERS = 2**23  # of the beliefs that are kept together: memory stays bounded with long episodes


@dataclass(frozen=True, eq=False, repr=False)
class Episodes(Carded, Sequence[Episode]):
    """The episodes of one policy, all their steps end to end; a sequence of `Episode`.

    Attributes:
        problem: the world, or the recorded tracks, in which they took place.
        policy: the one that acted, a `Policy` or a `Rule`; None where it is no table (a playback, a function that
            draws).
        seeds: of each of the E episodes.
        start: `[E]`, cells in which the targets were located at the start.
        first: `[E + 1]`, where each episode's steps begin in the columns below, and S.
        misses: `[S]`, n before each step.
        target: `[S]`, cell after the step, M once exited.
        located: `[S]`, whether the target was located there.
        reward: `[S]`.
        truncated: `[S]`, whether the step was the last one allowed.
        sensors: `[S]`, how many were on.
        bits: `[S, ceil(sensors/8)]`, the actions, eight sensors to a byte; None where they follow from the policy.
        key: `[S]`, the policy's key before each step; None where it is the last cell alone.
        mode: `[S]`, the target's mode after the step, -1 once exited; None where targets have none.
        start_mode: `[E]`, their modes at the start; 0 where they have none.
    """

    problem: Any
    policy: Any
    seeds: Sequence[int]
    start: Indices
    first: Indices
    misses: npt.NDArray[np.int32]
    target: npt.NDArray[np.int32]
    located: BoolArray
    reward: Floats
    truncated: BoolArray
    sensors: npt.NDArray[np.int32]
    bits: npt.NDArray[np.uint8] | None = None
    key: npt.NDArray[np.int32] | None = None
    mode: npt.NDArray[np.int32] | None = None
    start_mode: Indices | None = None

    @classmethod
    def of(
        cls,
        problem: Subject,
        policy: Policy | Rule | None,
        seeds: Sequence[int],
        batches: Sequence[Columns],
    ) -> Self:
        """The episodes of some batches, in their order; each has the columns, and the `length` of its episodes.

        At least one batch, which without `seeds` gives no more than the types of the columns.
        """
        columns = {
            name: np.concatenate([each[name] for each in batches])[: None if seeds else 0]
            for name in batches[0]
        }
        # Lengths 2 1 3 begin at 0 2 3, and end at 6: episode i has the steps first[i] ... first[i + 1] - 1.
        first = np.concatenate([[0], np.cumsum(columns.pop("length"))])
        return cls(problem, policy, list(seeds), first=first, **columns)

    def __len__(self) -> int:
        return len(self.seeds)

    @overload
    def __getitem__(self, which: int) -> Episode: ...
    @overload
    def __getitem__(self, which: slice) -> list[Episode]: ...
    def __getitem__(self, which: int | slice) -> Episode | list[Episode]:
        if isinstance(which, slice):
            return [self._episode(number) for number in range(len(self))[which]]
        return self._episode(range(len(self))[which])

    @property
    def nbytes(self) -> int:
        """Bytes of all columns."""
        return sum(getattr(column, "nbytes", 0) for column in vars(self).values())

    def card(self) -> Card:
        """Number of episodes and steps, and their figures with standard errors."""
        problem = self.problem
        task = f"{grid_words(problem.size)}, T_max {problem.t_max}"
        facts = {"problem": f"{type(problem).__name__}, {task}", "steps": f"{len(self.target):,}"}
        title = f"Episodes: {len(self):,}"
        if not len(self):
            return Card(title, facts)
        found = self.figures()
        for name, each, form in (
            ("AIHTR", found.aihtr, decimal),
            ("accuracy", found.accuracy, percent),
            ("sensors per step", found.sensors_per_step, decimal),
            ("safe actions per episode", found.safe_per_episode, decimal),
            ("steps per episode", found.expected_length, decimal),
        ):
            facts[name] = f"{form(each.mean)} ± {form(each.standard_error)}"
        return Card(f"{title} (figures: mean ± standard error)", facts)

    def _episode(self, number: int) -> Episode:
        steps, start = self._steps(number), self.start[number]
        mode = np.int64(0) if self.start_mode is None else self.start_mode[number]
        truncated = bool(self.truncated[steps][-1])
        made = Episode(
            number=number,
            seed=self.seeds[number],
            policy=0,
            start=start if start.ndim else int(start),
            misses=self.misses[steps].astype(np.int64),
            action=np.zeros((0, 0), bool),
            target=self.target[steps].astype(np.int64),
            located=self.located[steps],
            reward=self.reward[steps],
            terminated=not truncated,
            truncated=truncated,
            mode=None if self.mode is None else self.mode[steps].astype(np.int64),
            start_mode=mode if mode.ndim else int(mode),
        )
        return replace(made, action=self._action(made))

    def _steps(self, number: int) -> slice:
        return slice(int(self.first[number]), int(self.first[number + 1]))

    def _state(self, episode: Episode) -> tuple[Tensor, Tensor]:
        """`[T]` each, the policy's key and n before each step."""
        key = episode.last_cell
        if self.key is not None:
            key = self.key[self._steps(episode.number)].astype(np.int64)
        return torch.from_numpy(key), torch.from_numpy(episode.misses)

    def _action(self, episode: Episode) -> BoolArray:
        """`[T, S]`."""
        # A policy with a table needs no bits: its action follows from (key, misses), and S rows of M bits are not
        # kept.
        if self.bits is not None:
            count = self.problem.task.total_sensors
            bits = self.bits[self._steps(episode.number)]
            return np.unpackbits(bits, axis=-1, count=count).astype(np.bool_)
        found: BoolArray = self.policy.act(*self._state(episode)).numpy()
        return found

    def figures(self) -> Simulation:
        """The policy's figures from the episodes, with standard errors."""
        in_grid = self.target < self.problem.num_cells
        forced = (self.misses > self.problem.t_max) & in_grid
        # Sensors are counted where they cost: not at the exit, nor where the safe action replaced them.
        chosen = self.sensors * (in_grid & ~forced)
        steps = np.ones(len(self.target))
        columns = (self.reward, in_grid, self.located, chosen, forced, steps)
        # Every episode has a step, so that no two of `first` are the same and each sum belongs to one episode.
        reward, inside, detections, sensors, safe, length = (
            np.add.reduceat(column.astype(np.float64), self.first[:-1]) for column in columns
        )
        every = np.ones(len(self))
        return Simulation(
            episodes=len(self),
            aihtr=mean_ratio(reward, every),
            accuracy=mean_ratio(detections, inside),
            sensors_per_step=mean_ratio(sensors, inside),
            safe_per_episode=mean_ratio(safe, every),
            expected_length=mean_ratio(length, every),
        )

    @property
    def _at_once(self) -> tuple[int, int]:
        """Episodes that are completed together at most, and steps of them where it is more than one."""
        world, cells = self.problem.model, self.problem.num_cells
        states = cells if world is None else world.num_states
        return max(1, min(256, _BELIEF // states)), _NUMBERS // cells

    def _completed(self, begin: int, end: int) -> Iterator[Episode]:
        """See `complete`; those from number `begin` to `end` - 1."""
        some = self[begin:end]
        check_layers(sum(map(len, some)), self.problem.num_cells)
        if (world := self.problem.model) is None:
            found = [np.zeros((len(each), self.problem.num_cells), np.float32) for each in some]
        else:
            found = beliefs(world, some)
        for episode, belief in zip(some, found, strict=True):
            yield replace(episode, belief=belief, probability=self._probability(episode))

    def _probability(self, episode: Episode) -> Floats:
        if self.policy is None:
            return self.problem.covered(episode.action).astype(np.float32)
        found: Floats = self.policy.seeing(*self._state(episode)).float().numpy()
        return found

    def complete(self) -> Iterator[Episode]:
        """The episodes with `belief`, and of one target with `probability`, computed for some of them at a time.

        Recorded tracks have no motion model; the belief of one target is 0 in all cells.
        """
        end, (most, steps) = 0, self._at_once
        while (begin := end) < len(self):
            # Of lengths 2 1 3 `first` is 0 2 3 6: four steps end after the second episode, and one within the first.
            fits = np.searchsorted(self.first, self.first[begin] + steps, side="right") - 1
            end = min(max(int(fits), begin + 1), begin + most)
            yield from self._completed(begin, end)

    def to_tensordict(self) -> TensorDict:
        """`[S]` the steps of all episodes, as of `Episode.to_tensordict`, and the number of each, `episode`."""
        parts = [
            each.to_tensordict(self.problem.task).set("episode", torch.full((len(each),), number))
            for number, each in enumerate(self)
        ]
        return cast(TensorDict, torch.cat(parts)) if parts else TensorDict({}, [0])

    def _shown(self, call: str, number: int) -> Episode:
        """A complete episode.

        Raises:
            UserError: there is no such episode; the line begins with `call`.
        """
        if not 0 <= number < len(self):
            raise UserError(f"{call}: episode {number}, expected 0 to {len(self) - 1}")
        return next(iter(self._completed(number, number + 1)))

    def page(self, file: str | Path, number: int = 0) -> Path:
        """Write an episode as a web page that needs no network, and return its path.

        Raises:
            UserError: there is no such episode, or the file cannot be written there.
        """
        from trackmdp.episodes.episode_page import page

        place = output_of(file, "page")
        write_text(place, page(self.problem, self._shown("page", number)))
        return place

    def video(self, file: str | Path, number: int = 0, *, speed: int = 4) -> Path:
        """Write an episode as a `.gif` or `.mp4` of `speed` steps per second, and return its path (extra `video`).

        Raises:
            UserError: there is no such episode, the file cannot be written there, another ending, or a package is
                missing.
        """
        from trackmdp.episodes.video import write_video

        place = output_of(file, "video")
        write_video(place, self.problem.single, self._shown("video", number), speed)
        return place
