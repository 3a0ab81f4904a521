"""Schema of the policies that are not learned: fixed rules and solvers.

The group `baseline` (evaluate) offers all of them, the group `solver` (solve) those that read the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from trackmdp.config.options import choice, option

__all__ = [
    "AllOnConfig",
    "BaselineConfig",
    "ClockedConfig",
    "FcrConfig",
    "LookaheadConfig",
    "MyopicConfig",
    "NoSensorsConfig",
    "OptimalConfig",
    "PlaybackConfig",
    "QmdpConfig",
    "RandomKConfig",
]


@dataclass(kw_only=True)
class BaselineConfig:
    """Base of the groups `baseline` and `solver`."""

    name: ClassVar[str]


@choice("baseline", "qmdp")
@choice("solver", "qmdp")
@dataclass(kw_only=True)
class QmdpConfig(BaselineConfig):
    """Q_MDP: sense every cell whose predicted probability is worth the sensor's price."""

    in_grid: bool = option("threshold c·p_in/r instead of the printed c/r")


@choice("baseline", "all_on")
@dataclass(kw_only=True)
class AllOnConfig(BaselineConfig):
    """All sensors on, always."""


@choice("baseline", "none")
@dataclass(kw_only=True)
class NoSensorsConfig(BaselineConfig):
    """No sensor on until the safe action is forced."""


@choice("baseline", "random_k")
@dataclass(kw_only=True)
class RandomKConfig(BaselineConfig):
    """k sensors drawn at random each step."""

    k: int = option("sensors switched on, at most M", unit="sensors", ge=0)


@choice("baseline", "myopic")
@dataclass(kw_only=True)
class MyopicConfig(BaselineConfig):
    """Sense the cells whose belief, conditioned on the misses so far, exceeds a threshold."""

    threshold: float | None = option("predicted probability from which a cell is sensed; null = c·p_in/r", ge=0, le=1)


@choice("baseline", "clocked")
@choice("solver", "clocked")
@dataclass(kw_only=True)
class ClockedConfig(BaselineConfig):
    """Sets read off the clocked bound."""


@choice("baseline", "fcr")
@choice("solver", "fcr")
@dataclass(kw_only=True)
class FcrConfig(BaselineConfig):
    """First cost reduction: decide as if nothing were observed any more."""

    in_grid: bool = option("threshold c·p_in/r instead of c/r")


@choice("baseline", "lookahead")
@choice("solver", "lookahead")
@dataclass(kw_only=True)
class LookaheadConfig(BaselineConfig):
    """Plan some sets ahead, then count on a simpler value."""

    depth: int = option("sets planned ahead", unit="steps", ge=1, le=16)
    tail: str = option("value counted on after them", choices=("qmdp", "clocked"))


@choice("baseline", "optimal")
@choice("solver", "optimal")
@dataclass(kw_only=True)
class OptimalConfig(BaselineConfig):
    """Policy iteration, search and branch and bound: the optimum with a certificate, or an honest bracket."""

    time_limit: float = option("stop closing the bracket after this long", unit="s", gt=0)
    tolerance: float = option("bracket that counts as closed, relative to the value", ge=0, lt=1)


@choice("baseline", "playback")
@dataclass(kw_only=True)
class PlaybackConfig(BaselineConfig):
    """The actions of a logged episode again, step by step, whatever is observed; none on after the last."""

    file: str = option("the log", expects="a file written with log=mcap")
    episode: int = option("which of its episodes", ge=0)
