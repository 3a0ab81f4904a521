"""Options that were typed and would change nothing: refused, since whoever typed them expects an effect."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trackmdp.config.options import GROUPS, SELECTORS, nodes
from trackmdp.config.registry import conf_file
from trackmdp.errors import UserError


def refuse_ignored(cfg: Any, typed: Mapping[str, Any], choices: Mapping[str, Any]) -> None:
    """Refuse what has no effect on this config.

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
