"""Checks before anything is built: each option's range, rules between options, and options typed without effect."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trackmdp.config.options import GROUPS, SELECTORS, Option, leaves, nodes, options, refuse
from trackmdp.config.registry import conf_file
from trackmdp.errors import UserError


def validate(cfg: Any, place: str = "", root: Any = None) -> None:
    """Raise a `UserError` naming key, value and allowed range for the first option that breaks a rule.

    Args:
        cfg: the config of a command, or a part of one.
        place: dotted key of a part.
        root: the config that a part belongs to.
    """
    for key, described, value in leaves(cfg, place):
        if not described.allows(value):
            raise refuse(key, value, described.expected)
    # Rules between options may count on every single value; a node's rule comes after those of the nodes around it.
    for key, node in nodes(cfg, place):
        node.check(key, root or cfg)


def refuse_ignored(cfg: Any, typed: Mapping[str, Any], choices: Mapping[str, Any]) -> None:
    """Refuse what was typed and has no effect on this config: whoever typed it expects one.

    Args:
        cfg: the typed, valid config.
        typed: what was set, by dotted names; the defaults of `conf/` may well hold values that nothing reads.
        choices: group -> the file chosen from it (``{"algo": "ppo"}``, which credit=per_sensor turns into another).

    Raises:
        UserError: an option or a selector is not read.
    """
    for name, selector in SELECTORS.items():
        chosen = choices.get(selector.group)
        if name in typed and chosen and not _selects(name, selector.group, chosen):
            readers = ", ".join(each for each in GROUPS[selector.group] if _selects(name, selector.group, each))
            raise UserError(f"{name}={typed[name]}: not read by {selector.group}={chosen}, expected one of {readers}")
    for place, node in nodes(cfg):
        for name, why in node.ignored(cfg).items():
            key = f"{place}.{name}".lstrip(".")
            for given in typed:
                # `explore` without effect covers `algo.explore.start`, but not `algo.explored`.
                if given == key or given.startswith(f"{key}."):
                    raise UserError(f"{given}={typed[given]}: without effect {why}")


def _selects(selector: str, group: str, choice: str) -> bool:
    """Whether the file of a choice depends on the selector."""
    return f"${{{selector}}}" in conf_file(f"{group}/{choice}").read_text(encoding="utf-8")


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
