"""The figures of a policy for several targets, exact or with intervals."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.notebook.card import Card, Carded, counted_words, decimal
from trackmdp.solvers.evaluation import complement
from trackmdp.statistics import MeanInterval, ratio, student

FIGURES = ("aihtr", "reward_per_step", "accuracy", "sensors_per_step", "safe_per_step")
"""Figures of a policy in reports and tables."""
_FREE = 3
"""Degrees of freedom that the corrected mean takes: the mean and two slopes."""


@dataclass(frozen=True, repr=False)
class GroupEvaluation(Carded):
    """Figures of a policy for several targets.

    Attributes:
        totals: `[E, 7]` of simulated episodes: reward, steps of targets in the grid, detections, sensors on by choice,
            safe actions, steps of the episode, reward of single targets that are always known (`known_rewards`); or
            one row of exact expectations of the first six. On recorded tracks a row for each group of held-out tracks.
        exact: whether they are exact.
        expected_length: steps until the last target has left, exact; on recorded tracks the mean.
        controls: exact means of the second and of the last column; None on recorded tracks, which have none.
        units: the word for one of the units that totals are of, and the words after it; see `counted_words`.
    """

    totals: Array
    exact: bool
    expected_length: float
    controls: tuple[float, float] | None
    units: tuple[str, ...] = ("simulated episode",)

    def _ratio(self, part: int, whole: int, *, events: bool = False) -> MeanInterval:
        if self.exact:
            some, every = self.totals[0, [part, whole]].tolist()
            value = some / every if every else math.nan
            return MeanInterval(value, value, value, 1)
        return ratio(self.totals[:, part], self.totals[:, whole], events=events)

    @cached_property
    def aihtr(self) -> MeanInterval:
        """Expected reward of an episode.

        Most of its variance is that of two figures of the motion alone, whose means are known: it is taken out by
        least squares (control variates), whose own error counts (Student's t). Of few episodes it is a plain mean.
        """
        count, reward = len(self.totals), self.totals[:, 0]
        if self.exact:
            return MeanInterval(float(reward[0]), float(reward[0]), float(reward[0]), 1)
        if self.controls is None or count <= _FREE:
            return ratio(reward, np.ones(count))
        shown = self.totals[:, [1, 6]].mean(axis=0)
        columns, apart = self.totals[:, [1, 6]] - shown, shown - self.controls
        # Figures that are the same but for rounding count once.
        inverse = np.linalg.pinv(columns, rcond=1e-10)
        slope = inverse @ reward
        mean = float(reward.mean() - apart @ slope)
        rest, freedom = reward - reward.mean() - columns @ slope, count - _FREE
        share = 1.0 / count + float(((apart @ inverse) ** 2).sum())
        half = student(freedom) * math.sqrt(float((rest**2).sum()) / freedom * share)
        return MeanInterval(mean, mean - half, mean + half, count)

    @property
    def reward_per_step(self) -> MeanInterval:
        """Reward per step of an episode, the last exit step included."""
        if self.controls is None:
            return self._ratio(0, 5)
        found, share = self.aihtr, 1.0 / self.expected_length
        low, high = (None if end is None else end * share for end in (found.low, found.high))
        return MeanInterval(found.mean * share, low, high, found.n)

    @property
    def accuracy(self) -> MeanInterval:
        """Detections per step of a target in the grid."""
        if self.exact:
            return self._ratio(2, 1)
        steps, detections = self.totals[:, 1], self.totals[:, 2]
        return complement(ratio(steps - detections, steps, events=True))

    @property
    def sensors_per_step(self) -> MeanInterval:
        """Sensors on by choice per step."""
        return self._ratio(3, 5)

    @property
    def safe_per_step(self) -> MeanInterval:
        """Safe actions per step."""
        return self._ratio(4, 5, events=True)

    def less(self, other: GroupEvaluation) -> GroupEvaluation:
        """The differences of all totals to those of another policy for the same targets, whose steps are kept."""
        controls = None
        if self.controls and other.controls:
            (steps, mine), (_, theirs) = self.controls, other.controls
            controls = steps, mine - theirs
        totals = self.totals - other.totals
        # Policies differ most in long episodes, so that the steps explain a part of any difference.
        totals[:, 1] = self.totals[:, 1]
        return replace(self, totals=totals, controls=controls)

    @property
    def about(self) -> str:
        """What the figures are means over, and whether they have intervals."""
        if self.exact:
            return "exact"
        interval = "" if self.aihtr.low is None else ", 95 %"
        return f"{counted_words(len(self.totals), *self.units)}{interval}"

    @property
    def figures(self) -> dict[str, MeanInterval]:
        """The figures by their names."""
        return {name: getattr(self, name) for name in FIGURES}

    def report(self) -> dict[str, Any]:
        """As reports in JSON have it."""
        return {
            "exact": self.exact,
            "episodes": 0 if self.exact else len(self.totals),
            "expected_length": self.expected_length,
            "figures": {name: asdict(each) for name, each in self.figures.items()},
        }

    def card(self) -> Card:
        """The figures with their intervals."""
        facts = {name.replace("_", " "): with_ends(each) for name, each in self.figures.items()}
        facts["steps per episode"] = decimal(self.expected_length, 1)
        return Card(f"GroupEvaluation: {self.about}", {"AIHTR": facts.pop("aihtr")} | facts)


def with_ends(found: MeanInterval) -> str:
    """A figure and its interval."""
    if found.low is None or found.high is None or found.low == found.high:
        return decimal(found.mean, 4)
    above, below = found.high - found.mean, found.mean - found.low
    if abs(above - below) > 0.1 * (above + below):
        ends = f"{decimal(found.low, 4)} to {decimal(found.high, 4)}"
        return f"{decimal(found.mean, 4)} ({ends})"
    return f"{decimal(found.mean, 4)} ± {decimal(above, 4)}"
