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
"""Former name of an option (``group.option``) or of a choice (``group=choice``) -> its name."""


def refuse_renamed(key: str, choice: str = "") -> None:
    """Refuse the former name of an option, or of the choice `choice` of the group `key`.

    Raises:
        UserError: it is one; the message has the new name.
    """
    former = f"{key}={choice}" if choice else key
    if former in RENAMED:
        raise UserError(f"{former}: renamed, expected {RENAMED[former]}")


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


def unknown_choice(group: str, value: Any) -> UserError:
    """The refusal of what is none of the choices of a group or of a selector."""
    return refuse(group, value, f"one of {', '.join(choices_of(group))}")
