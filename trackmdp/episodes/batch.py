"""Simulated episodes as a few columns with the steps of all, from which an `Episode` is made on request; their figures.

Figures are means over episodes, each with its standard error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from trackmdp.arrays.types import AnyArray, Array, BoolArray, Indices
from trackmdp.episodes.belief_filter import beliefs
from trackmdp.episodes.episode import Episode, Floats, last_cells
from trackmdp.episodes.episode_draws import Columns
from trackmdp.episodes.grids import check_layers
from trackmdp.episodes.showing import Showing
from trackmdp.notebook.card import Card, decimal, grid_words, percent
from trackmdp.policies.policy import Policy
from trackmdp.world.problem import Problem

_BELIEF = 25_600  # cells, or hidden states, of the beliefs updated together: memory stays bounded on large grids


@dataclass(frozen=True)
class MeanEstimate:
    """A mean over simulated episodes with its standard error (nan for a single episode)."""

    mean: float
    standard_error: float


@dataclass(frozen=True)
class Simulation:
    """Figures of simulated episodes; `accuracy` is pooled, as the exact one, `episode_accuracy` the mean over episodes.

    Figures per step are ratios of sums over all episodes; their standard errors are those of a ratio estimate.
    """

    episodes: int
    aihtr: MeanEstimate
    accuracy: MeanEstimate
    episode_accuracy: MeanEstimate
    sensors_per_step: MeanEstimate
    safe_per_episode: MeanEstimate
    expected_length: MeanEstimate


@dataclass(frozen=True, eq=False, repr=False)
class Episodes(Showing[Episode]):
    """The episodes of one policy, all their steps end to end; a sequence of `Episode`.

    Attributes:
        problem: where they took place.
        policy: that acted; None for one that is no table (a playback, a function that draws).
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

    problem: Problem
    policy: Policy | None
    seeds: Sequence[int]
    start: Indices
    first: Indices
    misses: npt.NDArray[np.int32]
    target: npt.NDArray[np.int32]
    located: BoolArray
    reward: Floats
    truncated: BoolArray
    sensors: npt.NDArray[np.int32]
    bits: npt.NDArray[np.uint8] | None
    key: npt.NDArray[np.int32] | None = None
    mode: npt.NDArray[np.int32] | None = None
    start_mode: Indices | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        policy: Policy | None,
        seeds: Sequence[int],
        batches: Sequence[Columns],
    ) -> Episodes:
        """The episodes of some batches, in their order; each has the columns, and the `length` of its episodes.

        At least one batch, which without `seeds` gives no more than the types of the columns.
        """
        columns = {
            name: np.concatenate([each[name] for each in batches])[: None if seeds else 0]
            for name in batches[0]
        }
        # Lengths 2 1 3 begin at 0 2 3, and end at 6: episode i has the steps first[i] ... first[i + 1] - 1.
        first = np.concatenate([[0], np.cumsum(columns.pop("length"))])
        return cls(
            problem, policy, list(seeds), first=first, bits=columns.pop("bits", None), **columns
        )

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
        steps = slice(int(self.first[number]), int(self.first[number + 1]))
        target, located = self.target[steps].astype(np.int64), self.located[steps]
        misses, start = self.misses[steps].astype(np.int64), int(self.start[number])
        return Episode(
            number=number,
            seed=self.seeds[number],
            policy=0,
            start=start,
            misses=misses,
            action=self._action(
                steps, self._keys(steps, last_cells(start, target, located)[:-1]), misses
            ),
            target=target,
            located=located,
            reward=self.reward[steps],
            # Cell M stands for the exit, which no later step follows.
            terminated=bool(target[-1] == self.problem.num_cells),
            truncated=bool(self.truncated[steps][-1]),
            mode=None if self.mode is None else self.mode[steps].astype(np.int64),
            start_mode=0 if self.start_mode is None else int(self.start_mode[number]),
        )

    def _keys(self, steps: slice, last_cell: Indices) -> Indices:
        """`[T]`, the policy's key before each step."""
        return last_cell if self.key is None else self.key[steps].astype(np.int64)

    def _action(self, steps: slice, key: Indices, misses: Indices) -> BoolArray:
        """`[T, S]`."""
        # A policy with a table needs no bits: its action follows from (key, misses), and S rows of M bits are not
        # kept.
        if self.bits is not None:
            return np.unpackbits(
                self.bits[steps], axis=-1, count=self.problem.total_sensors
            ).astype(np.bool_)
        assert self.policy is not None
        return self.policy.act(torch.from_numpy(key), torch.from_numpy(misses)).numpy()

    def figures(self) -> Simulation:
        """The policy's figures from the episodes, with standard errors."""
        if not len(self):
            return _summary(np.zeros((6, 0)))
        in_grid = self.target < self.problem.num_cells
        forced = (self.misses > self.problem.t_max) & in_grid
        # Sensors are counted where they cost: not at the exit, nor where the safe action replaced them.
        chosen = self.sensors * (in_grid & ~forced)
        every = np.ones(len(self.target))
        columns: list[AnyArray] = [
            self.reward,
            in_grid,
            self.located,
            chosen,
            forced,
            every,
        ]
        # Every episode has a step, so that no two of `first` are the same and each sum belongs to one episode.
        totals: Array = np.stack(
            [np.add.reduceat(column.astype(np.float64), self.first[:-1]) for column in columns]
        )
        return _summary(totals)

    @property
    def _at_once(self) -> int:
        world = self.problem.model
        states = self.problem.num_cells if world is None else world.num_states
        return max(1, min(256, _BELIEF // states))

    def _completed(self, begin: int, end: int) -> Iterator[Episode]:
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
        steps = slice(int(self.first[episode.number]), int(self.first[episode.number + 1]))
        key = self._keys(steps, episode.last_cell)
        state = torch.from_numpy(key), torch.from_numpy(episode.misses)
        return self.policy.seeing(*state).float().numpy()


def _summary(totals: Array) -> Simulation:
    """The figures of E episodes from `[6, E]` sums over their steps.

    The rows of `totals` are reward, steps in the grid, detections, sensors on by choice, safe actions, and steps.
    """
    reward, steps, detections, sensors, forced, length = totals
    # An episode that starts with the exit has no step in the grid, and no accuracy.
    some = steps > 0
    return Simulation(
        episodes=len(reward),
        aihtr=_mean(reward),
        accuracy=_ratio(detections, steps),
        episode_accuracy=_mean(detections[some] / steps[some]),
        sensors_per_step=_ratio(sensors, steps),
        safe_per_episode=_mean(forced),
        expected_length=_mean(length),
    )


def _mean(values: Array) -> MeanEstimate:
    if len(values) == 0:
        return MeanEstimate(math.nan, math.nan)
    error = float(values.std(ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return MeanEstimate(float(values.mean()), error)


def _ratio(part: Array, whole: Array) -> MeanEstimate:
    """Σ part / Σ whole; its standard error by the delta method.

    The ratio R = mean(p) / mean(w) errs to first order by mean(p - R w) / mean(w), a mean over episodes.
    """
    if not whole.any():
        return MeanEstimate(math.nan, math.nan)
    ratio = float(part.sum() / whole.sum())
    residual = part - ratio * whole
    scale = float(whole.mean()) * math.sqrt(len(part))
    return MeanEstimate(ratio, float(residual.std(ddof=1)) / scale if len(part) > 1 else math.nan)
