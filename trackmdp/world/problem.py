"""A problem: a world, whose motion is known, or recorded tracks in place of it."""

from __future__ import annotations

from typing import TypeAlias

from trackmdp.errors import UserError
from trackmdp.recordings.tracks import Recorded
from trackmdp.world.model import World

Problem: TypeAlias = World | Recorded
"""The subject of learning and evaluation: a world with its motion model, or recorded tracks."""


def modelled(problem: Problem, caller: str) -> World:
    """The problem, if it has a motion model.

    Raises:
        UserError: it is recorded tracks, or several targets.
    """
    if problem.model is None:
        kind = type(problem).__name__
        raise UserError(f"{caller}: needs a motion model, expected a World, not a {kind}")
    return problem.model


def check_sensors(world: World) -> None:
    """Refuse a world for the paper's theorems, which are on a sensor in every cell.

    Raises:
        UserError: some cell has none.
    """
    if not world.available.all():
        cell = int(world.available.argmin())
        raise UserError(
            f"cost.sensor: nan in cell {cell} (no sensor); verify: expected a price in every cell"
        )
