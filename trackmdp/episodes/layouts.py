"""A layout for viewers that take Lichtblick's form: maps in layers, plots of the steps, where targets were located.

`layout.json` is an export of the viewers: two maps of three layers each (a field of `/grid`, over it the cells sensed,
except on the policy's map, over those the target) with cameras that follow `/part`, the plots, and the last
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
from trackmdp.episodes.schema import belief_topic
from trackmdp.episodes.target_colours import COLOURS, colour_of
from trackmdp.world.group import Subject


def layout(size: tuple[int, int], targets: int = 1) -> dict[str, Any]:
    """The layout as plain values, for a grid of `size` (rows, columns)."""
    made: dict[str, Any] = json.loads(
        files("trackmdp.episodes").joinpath("layout.json").read_text(encoding="utf-8")
    )
    seen = PART
    if targets > 1:
        made, seen = _of_several(made, min(targets, len(COLOURS))), max(size)
    for panel in made["configById"].values():
        if "cameraState" in panel:
            # Without perspective the distance is the height of the view, in cells: the part and a margin.
            panel["cameraState"]["distance"] = 1.2 * min(max(size), seen)
            panel["layers"] = {f"lines {place}": each for place, each in enumerate(_lines(size))}
    return made


def _of_several(made: dict[str, Any], targets: int) -> dict[str, Any]:
    """The layout with the first targets, each in its colour on one map of the whole grid."""
    panels = made["configById"]
    del panels["3D!policy"]
    made["layout"]["first"] = "3D!belief"
    belief, misses, seen = (
        panels[name] for name in ("3D!belief", "Plot!misses", "StateTransitions!seen")
    )
    whole = belief["topics"]["/grid"]
    belief["topics"] = {
        "/grid": whole,
        "/active": belief["topics"]["/active"],
        "/targets": {"visible": True},
    }
    belief["topics"] |= {belief_topic(k): whole | {"visible": False} for k in range(targets)}
    active, path = misses["paths"]
    of_each = [path | {"value": f"/step.n[{k}]", "color": colour_of(k)} for k in range(targets)]
    misses["paths"] = [active | {"color": "#808080"}, *of_each]
    seen["paths"] = [seen["paths"][0] | {"value": f"/step.obs[{k}]"} for k in range(targets)]
    titles = {
        "3D!belief": "targets expected, sensors on (light), targets (discs)",
        "Plot!misses": "sensors on (grey), misses before, by target",
        "StateTransitions!seen": "cell in which each target was located (-1: missed)",
    }
    for name, title in titles.items():
        panels[name] |= {f"{viewer}PanelTitle": title for viewer in ("foxglove", "lichtblick")}
    return made


def _lines(size: tuple[int, int]) -> list[dict[str, Any]]:
    """Lines around all cells, over the belief and under the sensors.

    Viewers draw them as squares only: a grid of 4 x 6 cells has two of side 4 over each other, from columns 0 and 2.
    """
    side = min(size)
    count = -(-max(size) // side)
    # from the first to the last place that the square has along either side
    corners = (np.linspace([0, 0], np.array(size) - side, count).round() + side / 2).tolist()
    same = {
        "layerId": "foxglove.Grid",
        "visible": True,
        "frameId": "grid",
        "size": side,
        "divisions": side,
    }
    same |= {"lineWidth": 1, "color": "#80808080"}
    return [same | {"position": [x, y, 0.005]} for y, x in corners]


def write_layout(file: Path, problem: Subject) -> None:
    """Write the layout of a log as JSON."""
    made = layout(problem.single.size, max(len(problem.targets), 1))
    write_text(file, json.dumps(made, indent=2) + "\n")
