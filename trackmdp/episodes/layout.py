"""A layout for viewers that take Lichtblick's form: two maps, plots of the step, the state of the target."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trackmdp.durable import write_text

__all__ = ["layout", "write_layout"]


def layout() -> dict[str, Any]:
    """The layout as plain values."""
    panels: dict[str, Any] = {
        "3D!belief": _map("belief"),
        "3D!policy": _map("policy"),
        "Plot!misses": _plot("/step.n", "/step.n_active"),
        "Plot!reward": _plot("/step.reward", "/step.ep_return"),
        "StateTransitions!seen": {
            "isSynced": True,
            "paths": [{"value": "/step.obs", "timestampMethod": "publishTime"}],
        },
        "RawMessages!episode": {"topicPath": "/episode"},
    }
    maps = _split("row", "3D!belief", "3D!policy")
    plots = _split("column", "Plot!misses", _split("column", "Plot!reward", "StateTransitions!seen"))
    arrangement = _split("column", maps, _split("row", plots, "RawMessages!episode"))
    return {"configById": panels, "globalVariables": {}, "userNodes": {}, "layout": arrangement}


def _map(colour_field: str) -> dict[str, Any]:
    grid = {
        "visible": True,
        "colorField": colour_field,
        "colorMode": "colormap",
        "colorMap": "turbo",
        "minValue": 0,
        "maxValue": 1,
    }
    camera = {"perspective": False, "phi": 0, "thetaOffset": 0, "distance": 15, "targetOffset": [5, 5, 0]}
    return {"foxglovePanelTitle": colour_field, "followTf": "grid", "topics": {"/grid": grid}, "cameraState": camera}


def _plot(*paths: str) -> dict[str, Any]:
    lines = [{"value": path, "enabled": True, "timestampMethod": "publishTime"} for path in paths]
    return {"paths": lines, "xAxisVal": "timestamp", "isSynced": True, "showLegend": True}


def _split(direction: str, first: Any, second: Any) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second}


def write_layout(file: Path) -> None:
    """Write the layout as JSON."""
    write_text(file, json.dumps(layout(), indent=2) + "\n")
