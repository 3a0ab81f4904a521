"""Messages about names and values that are not allowed: one line, the same from Python and at the terminal."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from trackmdp.config.options import Option, choices_of, refuse
from trackmdp.errors import UserError

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
