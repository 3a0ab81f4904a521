"""Checks before anything is built: names, each option's range, rules between options, and options without effect.

What is refused is told in one line, the same from Python and at the terminal.
"""

from __future__ import annotations

import copy
import difflib
import itertools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from trackmdp.config.options import GROUPS, SELECTORS, Option, choices_of, leaves, nodes, options, refuse
from trackmdp.config.registry import conf_file
from trackmdp.errors import UserError

_T = TypeVar("_T")

RENAMED: dict[str, str] = {
    "algo.average": "algo.ema_decay",
    "algo.block": "partition.block",
    "algo.clip": "algo.clip_epsilon",
    "algo.lam": "algo.gae_lambda",
    "algo.lr": "algo.learning_rate",
    "kernel.homogeneous": "algo.share_cells",
    "log.episodes": "log.mcap.episodes",
    "log.evaluations": "log.mcap.evaluations",
    "log.every": "log.csv.every",
    "log.layout": "log.mcap.layout",
    "lr": "algo.learning_rate",
}
"""Former name of an option (``group.option``) -> its name."""


def refuse_renamed(key: str) -> None:
    """Refuse the former name of an option.

    Raises:
        UserError: it is one; the message has the new name.
    """
    if key in RENAMED:
        raise UserError(f"{key}: renamed, expected {RENAMED[key]}")


def suggestion(name: str, known: Iterable[str], listed: Iterable[str] | None = None) -> str:
    """`, did you mean ...? (known: ...)` for a name that is none of the known ones; `listed`: name only these."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1)
    meant = f", did you mean {close[0]}?" if close else ""
    return f"{meant} (known: {', '.join(names if listed is None else listed) or 'none'})"


def unknown_option(key: str, known: Mapping[str, Option]) -> UserError:
    """The refusal of a dotted key that does not exist, naming those that stand beside it."""
    parent = key.rpartition(".")[0]
    beside = [name for name in known if name.startswith(f"{parent}.")] if parent else []
    # For `algo.epoch` the options of the algorithm; for a misspelt group (`alg.epochs`) the first parts of all keys,
    # each once and in their order, which a set would not keep.
    names = beside or list(dict.fromkeys(name.split(".")[0] for name in known))
    return UserError(f"{key}: unknown option{suggestion(key, known, names)}")


def check_option(key: str, value: Any, known: Mapping[str, Option]) -> None:
    """Refuse an option that is not among the known ones, or a value that it does not allow.

    Raises:
        UserError: it is one; the message names the option that may be meant.
    """
    if key not in known:
        refuse_renamed(key)
        *parents, _ = itertools.accumulate(key.split("."), "{}.{}".format)
        if above := next((each for each in parents if each in known), None):
            raise UserError(f"{above}: a mapping, expected {known[above].expected}")
        raise unknown_option(key, known)
    if not known[key].allows(value):
        raise refuse(key, value, known[key].expected)


def check_choice(group: str, name: Any) -> None:
    """Refuse what is none of the choices of a group or of a selector.

    Raises:
        UserError: it is none.
    """
    if not isinstance(name, str) or name not in choices_of(group):
        raise refuse(group, name, f"one of {', '.join(choices_of(group))}")


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
    _each_path(cfg, lambda path: str(folder / path))  # `path` itself where that is absolute


def own_paths(cfg: _T, folder: Path) -> _T:
    """A copy in which what lies in `folder`, that of the run, is named relative to it: a run may be moved."""
    copied, place = copy.deepcopy(cfg), folder.absolute()

    def relative(path: str) -> str:
        return str(Path(path).relative_to(place)) if Path(path).is_relative_to(place) else path

    _each_path(copied, relative)
    return copied


def _each_path(cfg: Any, change: Callable[[str], str]) -> None:
    for _, node in nodes(cfg):
        for name, described in options(type(node)).items():
            value = vars(node)[name]
            # resume=auto is a word, not a file called `auto`.
            if isinstance(described, Option) and described.path and value not in described.words:
                setattr(node, name, _changed(value, change))


def _changed(value: Any, change: Callable[[str], str]) -> Any:
    """A path, or in a list of choices with their options (`kernel.regimes`) each `path`; anything else as it is."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, list):
        return [_changed(each, change) if isinstance(each, dict) else each for each in value]
    return value | {"path": _changed(value["path"], change)} if isinstance(value, dict) and "path" in value else value
