"""A layout for viewers that take Lichtblick's form: maps in layers, plots of the steps, where targets were located.

`layout.json` is what the viewers export: two maps of three layers each (a field of `/grid`, over it the cells sensed,
which the map of the policy leaves out, over those the target), whose cameras follow `/part`, the plots, and the last
`/episode`.
The lines of a plot are named by their colours in its title: a legend would lie over them.
Of the times that Foxglove knows, Lichtblick draws lines for `receiveTime` alone, and it shows nothing of a layout
without a speed: a step takes 0.1 s of the log, at 0.2 half a second.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.durable import write_text
from trackmdp.episodes.grids import PART


def layout(size: tuple[int, int]) -> dict[str, Any]:
    """The layout as plain values, for a grid of `size` (rows, columns)."""
    made: dict[str, Any] = json.loads(files("trackmdp.episodes").joinpath("layout.json").read_text(encoding="utf-8"))
    for panel in made["configById"].values():
        if "cameraState" in panel:
            # Without perspective the distance is the height of what is seen, in cells: the part and a margin.
            panel["cameraState"]["distance"] = 1.2 * min(max(size), PART)
            panel["layers"] = {f"lines {place}": each for place, each in enumerate(_lines(size))}
    return made


def _lines(size: tuple[int, int]) -> list[dict[str, Any]]:
    """Lines around all cells, over the belief and under the sensors.

    Viewers draw them as squares only: a grid of 4 x 6 cells has two of side 4 over each other, from columns 0 and 2.
    """
    side = min(size)
    count = -(-max(size) // side)
    # from the first to the last place that the square has along either side
    corners = (np.linspace([0, 0], np.array(size) - side, count).round() + side / 2).tolist()
    return [
        {
            "layerId": "foxglove.Grid",
            "visible": True,
            "frameId": "grid",
            "size": side,
            "divisions": side,
            "lineWidth": 1,
            "color": "#80808080",
            "position": [x, y, 0.005],
        }
        for y, x in corners
    ]


def write_layout(file: Path, size: tuple[int, int]) -> None:
    """Write the layout as JSON."""
    write_text(file, json.dumps(layout(size), indent=2) + "\n")
