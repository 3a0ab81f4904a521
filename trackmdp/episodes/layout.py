"""A layout for viewers that take Lichtblick's form: maps in layers, plots of the steps, where targets were located."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trackmdp.durable import write_text


def layout(size: tuple[int, int]) -> dict[str, Any]:
    """The layout as plain values, its cameras over a grid of `size` (rows, columns)."""
    panels: dict[str, Any] = {
        "3D!belief": _map("belief", size) | _title("belief, sensors on (light), target (dot)"),
        "3D!policy": _map("policy", size) | _title("probability of being sensed, target (dot)"),
        "Plot!misses": _plot("/step.n_active", "/step.n") | _title("sensors on (orange), misses before (blue)"),
        "Plot!reward": _plot("/step.ep_return") | _title("total reward of the episode"),
        "StateTransitions!seen": {"isSynced": True, "paths": [_path("/step.obs")]}
        | _title("cell in which the target was located (-1: missed)"),
        "RawMessages!episode": {"topicPath": "/episode"} | _title("episode"),
    }
    # The cells sensed are what the map of the policy shows.
    panels["3D!policy"]["topics"]["/active"]["visible"] = False
    plots = _split("column", "Plot!misses", _split("column", "Plot!reward", "StateTransitions!seen"))
    arrangement = _split("column", _split("row", *list(panels)[:2]), _split("row", plots, "RawMessages!episode"))
    # Lichtblick shows nothing of a layout without a speed; a step takes 0.1 s of the log, here half a second.
    playback = {"playbackConfig": {"speed": 0.2}}
    return {"configById": panels, "globalVariables": {}, "userNodes": {}, "layout": arrangement, **playback}


def _map(field: str, size: tuple[int, int]) -> dict[str, Any]:
    """A panel of three layers: a field of `/grid`, over it the cells sensed, over those the target."""
    layers: dict[str, dict[str, Any]] = {
        "/grid": {"colorField": field, "colorMode": "colormap", "colorMap": "turbo"},
        "/active": {"colorField": "active", "colorMode": "gradient", "gradient": ["#ffffff00", "#ffffff80"]},
        "/target": {"colorField": "target", "colorMode": "gradient", "gradient": ["#ff00ff00", "#ff00ffff"]},
    }
    rows, columns = size
    # Cells are squares of side 1 from (0, 0) on, x along the columns; without perspective the distance is the height of
    # what is seen. A grid of 4 x 6 cells is looked at from above (3, 2), over a height of 9.
    camera = {
        "perspective": False,
        "phi": 0,
        "thetaOffset": 0,
        "distance": 1.5 * max(rows, columns),
        "targetOffset": [columns / 2, rows / 2, 0],
    }
    topics = {name: {"visible": True, "minValue": 0, "maxValue": 1, **layer} for name, layer in layers.items()}
    return {"followTf": "grid", "topics": topics, "cameraState": camera}


def _title(text: str) -> dict[str, str]:
    return {f"{viewer}PanelTitle": text for viewer in ("foxglove", "lichtblick")}


def _plot(*paths: str) -> dict[str, Any]:
    return {
        # named by their colours in the title: a legend would lie over the lines
        "paths": [
            _path(path) | {"enabled": True, "color": colour}
            for path, colour in zip(paths, ("#d55e00", "#0072b2"), strict=False)
        ],
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": False,
    }


def _path(path: str) -> dict[str, Any]:
    # Of the times that Foxglove knows, Lichtblick draws lines for this one only.
    return {"value": path, "timestampMethod": "receiveTime"}


def _split(direction: str, first: Any, second: Any) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second}


def write_layout(file: Path, size: tuple[int, int]) -> None:
    """Write the layout as JSON."""
    write_text(file, json.dumps(layout(size), indent=2) + "\n")
