"""Sensors as a user describes them: the choices of the group `sensor`, as arguments of a `Task`."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackmdp.config.sensing import lattice
from trackmdp.errors import UserError
from trackmdp.world.checks import PROBABILITIES
from trackmdp.world.coverage import Coverage, discs
from trackmdp.world.files import per_cell, read_matrix
from trackmdp.world.model import Size, grid_size


def perfect(size: Size) -> dict[str, Any]:  # noqa: ARG001
    """No sensor misses, which is what a `Task` takes for granted."""
    return {}


def miss(size: Size, *, p_d: float | list[float] | str, p_s: float | list[float] | str) -> dict[str, Any]:
    """p_d of the sensors and p_s of the safe action.

    Raises:
        UserError: a file is missing or malformed, or does not have one probability per cell.
    """
    return {
        "detection": per_cell("sensor.p_d", p_d, size, PROBABILITIES),
        "safe_detection": per_cell("sensor.p_s", p_s, size, PROBABILITIES),
    }


def false_alarm(size: Size, *, p_d: float | list[float] | str, p_f: float) -> dict[str, Any]:  # noqa: ARG001
    """p_d of the sensors; p_f is no matter of the task, which policies are made for, but of their evaluation.

    Raises:
        UserError: as `miss`.
    """
    return {"detection": per_cell("sensor.p_d", p_d, size, PROBABILITIES)}


def footprint(size: Size, *, radius: float, spacing: int, path: str | None) -> dict[str, Any]:
    """Discs of `radius` around the places of a lattice, or the footprints in a file.

    Raises:
        UserError: the file is missing or malformed, or holds no footprints on this grid.
    """
    rows, columns = grid_size(size)
    if path is not None:
        table = read_matrix("sensor.path", path, name="coverage")
        try:
            return {"coverage": Coverage.of(table, rows * columns)}
        except UserError as error:  # the option at fault is told with it
            raise UserError(f"sensor.path={path}: {str(error).removeprefix('coverage: ')}") from error
    places = np.stack(np.meshgrid(lattice(rows, spacing), lattice(columns, spacing), indexing="ij"), axis=-1)
    return {"coverage": Coverage.of(discs((rows, columns), places.reshape(-1, 2), radius), rows * columns)}
