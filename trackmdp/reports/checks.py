"""What results of a run must be before they are counted, labelled and drawn; they may be somebody else's.

Raises:
    Exception: of any kind, where they are something else; call these inside `untrusted.decoded`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LARGEST_FIGURE = 1e15
"""No figure of a run is as large, and sums and squares of smaller ones stay finite."""


def number(key: str, value: Any) -> float:
    """`value`, which has to be a number."""
    # JSON as Python reads it knows NaN and Infinity; neither is less than LARGEST_FIGURE.
    if type(value) not in (int, float) or not abs(value) < LARGEST_FIGURE:
        raise TypeError(f"{key}: {str(value)[:40]}, expected a number")
    return float(value)


def checked_settings(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings with all options that runs are grouped by, of their types; all others are only shown."""
    for key in ("algo.name", "kernel.name"):
        if not isinstance(settings[key], str):
            raise TypeError(f"{key}: expected a name")
    # `type(...) is`: True is an int to `isinstance`, and no seed.
    if type(settings["seed"]) is not int or type(settings["grid.size"]) not in (int, list):
        raise TypeError("seed, grid.size: expected whole numbers")
    return settings


def checked_figures(figures: Mapping[str, Any]) -> dict[str, float | None]:
    """Figures of a run: all that it earned and took; of the others some are None, as on recorded tracks."""
    for key in ("frames", "wall_seconds", "cpu_seconds", "aihtr"):
        number(key, figures[key])
    if not number("expected_length", figures["expected_length"]) > 0:  # regrets are per step
        raise ValueError(f"expected_length: {figures['expected_length']}, expected more than 0")
    return {key: None if value is None else number(key, value) for key, value in figures.items()}


def check_origin(key: str, said: Any) -> None:
    """See that versions, or a machine, are names and values: they are counted and shown."""
    if not isinstance(said, Mapping) or any(isinstance(value, (Mapping, list)) for value in said.values()):
        raise TypeError(f"{key}: expected names and values")


def check_manifest(manifest: Mapping[str, Any]) -> None:
    """See that a manifest tells where results come from in the form that a page shows."""
    if not isinstance(manifest["line"], str):
        raise TypeError("line: expected a text")
    for key in ("planned", "wall_seconds", "cpu_seconds"):
        if key != "planned" or manifest[key] is not None:
            number(key, manifest[key])
    for key in ("versions", "machines"):
        for entry in manifest[key]:
            check_origin(key, entry)
            number("runs", entry["runs"])
