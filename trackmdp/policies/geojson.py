"""A policy on a map: its sets and values as GeoJSON (RFC 7946)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.grid.place import Place
from trackmdp.policies.saved import LISTED_CELLS
from trackmdp.policies.table import PolicyTable


def map_features(policy: PolicyTable, value: Array | None = None) -> dict[str, Any]:
    """A feature collection: for each cell its square, its value, and the sensors on after a detection there.

    The properties of a cell are `cell`, `row`, `column`, `value`, and for n = 0 ... t_max misses `on_n`, the ids of the
    sensors, and `count_n`, their number. Of a policy that remembers more than the cell the sets are those of an
    episode's start.

    Args:
        policy: deterministic, of a grid on a map.
        value: `[M]` V(x); null where it is nan, or not given.

    Raises:
        UserError: see `checked_place`.
    """
    task, place = policy.task, checked_place(policy)
    keys = task.keys.start(np.arange(task.num_cells), 0)
    # Across 180 degrees longitudes go on beyond it: a square from 179.9 to -179.9 would be drawn around the world.
    middle = place.outline(task.rows // 2 * task.columns + task.columns // 2, task.size)[0][1]
    features = []
    for cell, key in enumerate(keys.tolist()):
        corners = [
            (lon - 360.0 * round((lon - middle) / 360.0), lat)
            for lat, lon in place.outline(cell, task.size)
        ]
        worth = math.nan if value is None else float(value[cell])
        row, column = divmod(cell, task.columns)
        about: dict[str, Any] = {"cell": cell, "row": row, "column": column}
        about["value"] = worth if math.isfinite(worth) else None
        for n in range(task.num_choices):
            on = policy.sensors(key, n)
            about |= {f"on_{n}": on, f"count_{n}": len(on)}
        square = {"type": "Polygon", "coordinates": [[*corners, corners[0]]]}
        features.append({"type": "Feature", "id": cell, "geometry": square, "properties": about})
    return {"type": "FeatureCollection", "features": features}


def checked_place(policy: PolicyTable) -> Place:
    """Where the grid of a policy is on the map.

    Raises:
        UserError: it is not known in latitude and longitude, the policy draws its sets, or the grid is too large for a
            file of text.
    """
    place, cells = policy.task.place, policy.task.num_cells
    if place is None or place.crs is None:
        raise UserError(
            "geojson: the grid has no latitude and longitude, expected a policy that was trained or solved with "
            "positions as lat, lon, or with grid.cell, grid.origin and grid.crs"
        )
    if not policy.deterministic:
        raise UserError("geojson: the policy draws its sets, expected a deterministic one")
    if cells > LISTED_CELLS:
        raise UserError(
            f"geojson: {cells:,} cells, expected at most {LISTED_CELLS:,}; format=sets takes more"
        )
    return place
