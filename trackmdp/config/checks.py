"""Checks that run before anything is built: the range of every option, and the rules between options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trackmdp.config.options import Option, leaves, nodes, options, refuse


def validate(cfg: Any) -> None:
    """Raise a `UserError` naming key, value and allowed range for the first option that breaks a rule."""
    for key, described, value in leaves(cfg):
        if not described.allows(value):
            raise refuse(key, value, described.expected)
    # Rules between options may count on every single value; a node's rule comes after those of the nodes around it.
    for key, node in nodes(cfg):
        node.check(key, cfg)


def absolute_paths(cfg: Any, folder: Path) -> None:
    """Resolve every path of the config against `folder`, where the user typed the command."""
    # Saved as absolute paths, they still mean the same files when the run is resumed from another folder.
    for _, node in nodes(cfg):
        for name, described in options(type(node)).items():
            value = vars(node)[name]
            if isinstance(described, Option) and described.path:
                # resume=auto is a word, not a file called `auto`.
                setattr(node, name, value if value in described.words else _absolute(value, folder))


def _absolute(value: Any, folder: Path) -> Any:
    """A path, or in a list of choices with their options (`kernel.regimes`) each `path`; anything else as it is."""
    if isinstance(value, str):
        return str(folder / value)  # `value` itself where that is absolute
    if isinstance(value, list):
        return [_absolute(each, folder) if isinstance(each, dict) else each for each in value]
    return value | {"path": _absolute(value["path"], folder)} if isinstance(value, dict) and "path" in value else value
