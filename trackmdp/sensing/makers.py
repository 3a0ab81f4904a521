"""Makers of the groups `cost` and `sensor`: from the options of a choice to arguments of `Task`."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackmdp.arrays.files import per_cell, read_matrix
from trackmdp.arrays.numbers import PRICES, PROBABILITIES
from trackmdp.config.sensors import lattice
from trackmdp.errors import UserError
from trackmdp.grid.size import Size, grid_size
from trackmdp.sensing.coverage import Coverage, discs


def paper_cost(
    size: Size,
    *,
    reward: float,
    sensor: float | list[float] | str,
    safe: float | None,
    budget: int | None,
    mean_budget: float | None,  # noqa: ARG001 (a matter of solving)
    sensors: int | None = None,
) -> dict[str, Any]:
    """r, c, D and B as arguments of `Task`; `sensors` is their number where there is not one in each cell.

    Raises:
        UserError: a file of prices is missing or malformed, or does not have one price per sensor.
    """
    return {
        "reward": reward,
        "cost": per_cell("cost.sensor", sensor, size, PRICES, sensors),
        "safe_cost": safe,
        "budget": budget,
    }


def perfect(size: Size) -> dict[str, Any]:  # noqa: ARG001
    """No sensor misses, the default of a `Task`."""
    return {}


def miss(
    size: Size, *, p_d: float | list[float] | str, p_s: float | list[float] | str
) -> dict[str, Any]:
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


def footprint(
    size: Size,
    *,
    radius: float,
    spacing: int,
    path: str | None,
    p_d: float | list[float] | str,
    p_s: float | list[float] | str,
    table: Any = None,
) -> dict[str, Any]:
    """Discs of `radius` around the places of a lattice, the footprints in a file, or a `table` in place of the file.

    p_d and p_s are those of `miss`.

    Raises:
        UserError: a file is missing or malformed, or does not fit this grid.
    """
    rows, columns = grid_size(size)
    missing = miss(size, p_d=p_d, p_s=p_s)
    if table is not None:
        return missing | {"coverage": Coverage.of(table, rows * columns)}
    if path is not None:
        table = read_matrix("sensor.path", path, name="coverage")
        try:
            return missing | {"coverage": Coverage.of(table, rows * columns)}
        except UserError as error:  # with the option at fault
            fault = str(error).removeprefix("coverage: ")
            raise UserError(f"sensor.path={path}: {fault}") from error
    places = np.meshgrid(lattice(rows, spacing), lattice(columns, spacing), indexing="ij")
    seen = discs((rows, columns), np.stack(places, axis=-1).reshape(-1, 2), radius)
    return missing | {"coverage": Coverage.of(seen, rows * columns)}
