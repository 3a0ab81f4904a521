"""A layout for viewers that take Lichtblick's form: maps in layers, plots of the steps, where targets were located.

`layout.json` is what the viewers export, but for the cameras: two maps of three layers each (a field of `/grid`, over
it the cells sensed, which the map of the policy leaves out, over those the target), the plots, and the last `/episode`.
The lines of a plot are named by their colours in its title: a legend would lie over them.
Of the times that Foxglove knows, Lichtblick draws lines for `receiveTime` alone, and it shows nothing of a layout
without a speed: a step takes 0.1 s of the log, at 0.2 half a second.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

from trackmdp.durable import write_text


def layout(size: tuple[int, int]) -> dict[str, Any]:
    """The layout as plain values, its cameras over a grid of `size` (rows, columns)."""
    rows, columns = size
    made: dict[str, Any] = json.loads(files("trackmdp.episodes").joinpath("layout.json").read_text(encoding="utf-8"))
    # Cells are squares of side 1 from (0, 0) on, x along the columns; without perspective the distance is the height of
    # what is seen. A grid of 4 x 6 cells is looked at from above (3, 2), over a height of 9.
    camera = {"distance": 1.5 * max(rows, columns), "targetOffset": [columns / 2, rows / 2, 0]}
    for panel in made["configById"].values():
        if "cameraState" in panel:
            panel["cameraState"] |= camera
    return made


def write_layout(file: Path, size: tuple[int, int]) -> None:
    """Write the layout as JSON."""
    write_text(file, json.dumps(layout(size), indent=2) + "\n")
