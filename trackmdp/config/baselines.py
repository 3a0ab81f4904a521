"""Schema of the policies that are not learned: fixed rules and solvers.

The group `baseline` (evaluate) has all of them, the group `solver` (solve) the ones that read the kernel.
"""

from __future__ import annotations

from typing import Any

from trackmdp.config.options import (
    GROUPS,
    ChoiceConfig,
    choice,
    count_option,
    file_option,
    listed,
    option,
    refuse,
    share_option,
)
from trackmdp.machine import SIZE_PATTERN


class BaselineConfig(ChoiceConfig):
    """Base of the groups `baseline` and `solver`.

    The code of a choice gets the world and the options of the choice, and returns a `Policy` or a `Solution`.

    Attributes:
        without_motion: needs no kernel; recorded tracks have none.
        knows_footprints: sensors may cover several cells.
        knows_budget: keeps to a limit on the sensors on in a step.
        whole_episodes: plans for episodes that only the exit ends; `grid.max_steps` then counts in the valuing alone.
    """

    without_motion = False
    whole_episodes = False
    knows_footprints = True
    knows_budget = True


@choice("baseline", "qmdp", makes="trackmdp.solvers.rules:qmdp")
class QmdpConfig(BaselineConfig):
    """Q_MDP: sense every cell with a predicted probability worth the sensor's price."""

    in_grid: bool = option("threshold c·p_in/r instead of the printed c/r")


@choice("baseline", "all_on", makes="trackmdp.policies.policy:Policy.all_on")
class AllOnConfig(BaselineConfig):
    """All sensors on, always."""

    without_motion = True


@choice("baseline", "none", makes="trackmdp.policies.policy:Policy.none")
class NoSensorsConfig(BaselineConfig):
    """No sensor on until the safe action is forced."""

    without_motion = True


@choice("baseline", "random_k", makes="trackmdp.policies.policy:Policy.random_k")
class RandomKConfig(BaselineConfig):
    """k sensors drawn at random each step."""

    without_motion = True
    k: int = option("sensors switched on, at most as many as there are", unit="sensors", ge=0)

    def check(self, key: str, root: Any) -> None:
        """No more sensors than there are."""
        count = root.sensor.count(root.grid)
        if count is not None and self.k > count:
            expected = f"at most {count}, the sensors of a grid.size={root.grid.size} grid"
            raise refuse(f"{key}.k", self.k, expected)


@choice("baseline", "myopic", makes="trackmdp.solvers.rules:myopic")
class MyopicConfig(BaselineConfig):
    """Sense the cells with a belief, given the misses so far, above a threshold."""

    threshold: float | None = share_option(
        "predicted probability from which a cell is sensed; null = c·p_in/r"
    )


@choice("baseline", "clocked", makes="trackmdp.solvers.rules:clocked_policy")
class ClockedConfig(BaselineConfig):
    """Sets read off the clocked bound."""


@choice("baseline", "fcr", makes="trackmdp.solvers.rules:fcr")
class FcrConfig(BaselineConfig):
    """First cost reduction: decide as if nothing were observed any more."""

    in_grid: bool = option("threshold c·p_in/r instead of c/r")


@choice("baseline", "lookahead", makes="trackmdp.solvers.lookahead:solve")
class LookaheadConfig(BaselineConfig):
    """Plan some sets ahead, then count on a simpler value."""

    depth: int = count_option("sets planned ahead", unit="steps", le=16)
    tail: str = option("value counted on after them", choices=("qmdp", "clocked"))


@choice("baseline", "optimal", makes="trackmdp.solvers.optimal:solve")
class OptimalConfig(BaselineConfig):
    """Policy iteration, search and branch and bound: the optimum with a certificate, or an honest bracket."""

    whole_episodes = True

    nodes: int = count_option(
        "choices of branch and bound after which the bracket is left as it is", unit="nodes"
    )
    time_limit: float | None = option(
        "stop after this time even so, at each price where there are several; the output then names it; null = never",
        unit="s",
        gt=0,
    )
    tolerance: float = option("bracket that counts as closed, relative to the value", ge=0, lt=1)
    memory: str | None = option(
        "memory that may be used: large grids are then solved in smaller regions; null = all memory of the machine",
        pattern=SIZE_PATTERN,
        expects="bytes, or a size such as 500MiB or 2GiB",
    )


@choice("baseline", "sets", makes="trackmdp.policies.saved:read_sets")
class SetsConfig(BaselineConfig):
    """The sets in a file of evaluate, solve, export or a run."""

    without_motion = True
    file: str = file_option("the sets", "a sets.json, or a sets.npz or policy.npz")


@choice("baseline", "playback", makes="trackmdp.policies.acting:Playback")
class PlaybackConfig(BaselineConfig):
    """The actions of a logged episode again, step by step, independent of observations; none on after the last."""

    file: str = file_option("the log", "a file written with log=[mcap]")
    episode: int = option("number of the episode", ge=0)

    def check(self, key: str, root: Any) -> None:
        """Played back episodes are simulated, and not logged a second time."""
        if root.log:
            raise refuse(
                "log",
                listed(root.log),
                "[] with baseline=playback: its episodes are logged already",
            )
        if root.episodes == 0:
            raise refuse(
                "episodes", 0, "at least 1 with baseline=playback, which is only simulated"
            )


SOLVERS = ("qmdp", "clocked", "fcr", "lookahead", "optimal")
GROUPS["solver"] = {name: GROUPS["baseline"][name] for name in SOLVERS}
