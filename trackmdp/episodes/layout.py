"""A layout for viewers that take Lichtblick's form: four maps, plots of the step, the state of the target."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trackmdp.durable import write_text

# A panel colours a grid by one of its fields, so that what is on, what is likely and what is true are one map each.
_MAPS = ("belief", "active", "target", "policy")


def layout(size: tuple[int, int]) -> dict[str, Any]:
    """The layout as plain values, its cameras over a grid of `size` (rows, columns)."""
    panels: dict[str, Any] = {f"3D!{field}": _map(field, size) for field in _MAPS} | {
        "Plot!misses": _plot("/step.n", "/step.n_active"),
        "Plot!reward": _plot("/step.reward", "/step.ep_return"),
        "StateTransitions!seen": {
            "isSynced": True,
            "paths": [{"value": "/step.obs", "timestampMethod": "publishTime"}],
        },
        "RawMessages!episode": {"topicPath": "/episode"},
    }
    belief, active, target, policy = (f"3D!{field}" for field in _MAPS)
    maps = _split("row", _split("row", belief, active), _split("row", target, policy))
    plots = _split("column", "Plot!misses", _split("column", "Plot!reward", "StateTransitions!seen"))
    arrangement = _split("column", maps, _split("row", plots, "RawMessages!episode"))
    return {"configById": panels, "globalVariables": {}, "userNodes": {}, "layout": arrangement}


def _map(colour_field: str, size: tuple[int, int]) -> dict[str, Any]:
    grid = {
        "visible": True,
        "colorField": colour_field,
        "colorMode": "colormap",
        "colorMap": "turbo",
        "minValue": 0,
        "maxValue": 1,
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
    return {"foxglovePanelTitle": colour_field, "followTf": "grid", "topics": {"/grid": grid}, "cameraState": camera}


def _plot(*paths: str) -> dict[str, Any]:
    lines = [{"value": path, "enabled": True, "timestampMethod": "publishTime"} for path in paths]
    return {"paths": lines, "xAxisVal": "timestamp", "isSynced": True, "showLegend": True}


def _split(direction: str, first: Any, second: Any) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second}


def write_layout(file: Path, size: tuple[int, int]) -> None:
    """Write the layout as JSON."""
    write_text(file, json.dumps(layout(size), indent=2) + "\n")
