"""Checks before anything is built: names, ranges, rules between options, and options without effect.

A refusal is one line, the same from Python and at the terminal. `build_config` makes the dataclasses of plain values.
"""

from __future__ import annotations

import copy
import difflib
import hashlib
import itertools
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import MISSING

from trackmdp.config.options import (
    GROUPS,
    Node,
    Option,
    as_float,
    is_number,
    leaves,
    nodes,
    options,
    refuse,
    typed_choices,
)
from trackmdp.errors import UserError

_T = TypeVar("_T")

RENAMED: dict[str, str] = {
    "algo.average": "algo.ema_decay",
    "algo.credit": "algo=a2c_per_sensor",
    "algo.lam": "algo.gae_lambda",
    "algo.lr": "algo.learning_rate",
    "algo=learned_kernel": "algo=model_based",
    "algo=path_counts": "algo=model_based",
    "credit": "algo=a2c_per_sensor",
    "kernel.cell": "grid.cell",
    "kernel.crs": "grid.crs",
    "kernel.homogeneous": "algo.share_cells",
    "kernel.origin": "grid.origin",
    "log.every": "log.csv.every",
    "lr": "algo.learning_rate",
}
"""Former or usual name of an option, or of a choice -> its name."""

_VALUES = {"cost": "cost.sensor", "sensor": "sensor=miss sensor.p_d"}
"""Group -> words that end in the option that is meant where the group is given a number."""

_FILES = {
    "cost": "cost.sensor",
    "sensor": "sensor=footprint sensor.path",
    "kernel": "kernel=table (or tracks) kernel.path",
}
"""The same where it is given a file."""


def suggestion(name: str, known: Iterable[str], listed: Iterable[str] | None = None) -> str:
    """`, did you mean ...? (known: ...)` for a name that is none of the known ones; `listed`: name only these."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1)
    meant = f", did you mean {close[0]}?" if close else ""
    return f"{meant} (known: {', '.join(names if listed is None else listed) or 'none'})"


def unknown_option(key: str, known: Mapping[str, Option]) -> UserError:
    """The refusal of a dotted key that does not exist, with the names beside it."""
    if key in RENAMED:
        return UserError(f"{key}: renamed, expected {RENAMED[key]}")
    # `algo.epochs` without algo=ppo is no misspelling, and no more is `log.mcap.episodes` without log=[mcap].
    group, _, name = key.partition(".")
    choice, _, own = name.partition(".")
    beneath = choice if f"{group}.{own}" not in known else None
    schemas = {each: GROUPS[group][each] for each in typed_choices(group)}
    others = [
        each
        for each, schema in schemas.items()
        if name in options(schema) or (each == beneath and own in options(schema))
    ]
    if full := next((x for each in others if (x := f"{group}.{each}.{name}") in known), None):
        return UserError(f"{key}: unknown option, did you mean {full}?")
    if others:
        choices = " or ".join(f"{group}={each}" for each in others)
        return UserError(f"{key}: an option of another choice, expected {choices} beside it")
    # For `algo.epoch` the options of the algorithm; for `alg.epochs` the first parts of all keys, each once.
    parent = f"{key.rpartition('.')[0]}."
    beside = [each for each in known if each.startswith(parent)]
    first = dict.fromkeys(each.split(".")[0] for each in known)
    # `algo.epoch` may mean an option of another algorithm than the one chosen; `log` has those of all that are chosen.
    several = any(each.split(".")[1] in schemas for each in beside)
    others = [] if several else [f"{group}.{x}" for each in schemas.values() for x in options(each)]
    return UserError(f"{key}: unknown option{suggestion(key, [*known, *others], beside or first)}")


def check_option(key: str, value: Any, known: Mapping[str, Option]) -> None:
    """Refuse an option that is not among the known ones, or a value that it does not allow.

    Raises:
        UserError: it is one; the message names the option that may be meant.
    """
    if key not in known:
        if inner := [name for name in known if name.startswith(f"{key}.")]:
            raise UserError(f"{key}={value}: expected {inner[0]}=value (known: {', '.join(inner)})")
        *parents, _ = itertools.accumulate(key.split("."), "{}.{}".format)
        if above := next((each for each in parents if each in known), None):
            raise UserError(f"{above}: a mapping, expected {known[above].expected}")
        raise unknown_option(key, known)
    if not known[key].allows(value):
        raise refuse(key, value, known[key].expected)


def check_choice(group: str, name: Any) -> None:
    """Refuse a name that is none of the choices of a group.

    Raises:
        UserError: there is no such choice.
    """
    if isinstance(name, str) and name in GROUPS[group]:
        return
    if (former := f"{group}={name}") in RENAMED:
        raise UserError(f"{former}: renamed, expected {RENAMED[former]}")
    meant = _VALUES if is_number(str(name)) else _FILES if Path(str(name)).suffix else {}
    if group in meant:
        raise UserError(f"{group}={name}: expected {meant[group]}={name}")
    none = ", or log=[] for none" if group == "log" and name is None else ""
    raise refuse(group, name, f"one of {', '.join(typed_choices(group))}{none}")


def validate(cfg: _T, place: str = "", root: Any = None, *, rules: bool = True) -> _T:
    """The config; the first option that is missing, is out of range or breaks a rule is refused.

    Args:
        cfg: the config of a command, or a part of one.
        place: dotted key of a part.
        root: the config that a part belongs to.
        rules: whether those between options are checked, beside each value by itself.

    Raises:
        UserError: the message has the key, the value and the range.
    """
    for key, item, value in leaves(cfg, place):
        if value == MISSING:
            raise UserError(f"{key}: missing, expected {item.expected}")
        if not item.allows(value):
            raise refuse(key, value, item.expected)
    # Rules between options may count on every single value; the rule of a node comes after those around it.
    for key, node in nodes(cfg, place) if rules else ():
        node.check(key, root or cfg)
    return cfg


def build_config(plain: Any, schema: type[_T], prefix: str = "") -> _T:
    """The dataclasses of a plain config; values are not checked.

    Args:
        plain: the config, or a part of it.
        schema: its dataclass.
        prefix: of a part, stands before its keys in messages, such as ``algo.``.

    Raises:
        UserError: a key is missing or unknown, or a choice is.
    """
    if not isinstance(plain, Mapping):
        raise UserError(f"{prefix.rstrip('.')}={plain}: expected a mapping")
    known = options(schema)
    # Unknown keys first: a misspelt key is missing as well, and this message has the right one.
    for key in plain:
        if key not in known:
            raise UserError(f"{prefix}{key}: unknown option{suggestion(str(key), known)}")
    for key in known:
        if key not in plain:
            raise UserError(f"{prefix}{key}: missing")
    return schema(**{key: _built(key, item, plain[key], prefix) for key, item in known.items()})


def _built(key: str, item: Option | Node, value: Any, prefix: str) -> Any:
    """The value of one key, or the dataclasses of a part."""
    if isinstance(item, Option):
        # `reward: 10` in a file is an integer to YAML; `type` leaves True, which is refused by its own check.
        return as_float(value) if item.kind is float and type(value) is int else value
    if value is None and item.optional:
        return None
    if value == MISSING:
        needed = f"{key}=NAME" if key in GROUPS else f"its {', '.join(options(item.schema))}"
        raise UserError(f"{prefix}{key}: missing, expected {needed}")
    if item.several and isinstance(value, Mapping):
        for name in value:
            check_choice(key, name)
        return {
            name: build_config(own, GROUPS[key][name], f"{prefix}{key}.{name}.")
            for name, own in value.items()
        }
    schema = item.schema
    if key in GROUPS and isinstance(value, Mapping):
        check_choice(key, value.get("name"))
        schema = GROUPS[key][value["name"]]
        value = {own: each for own, each in value.items() if own != "name"}
    return build_config(value, schema, f"{prefix}{key}.")


def refuse_ignored(cfg: Any, typed: Mapping[str, Any]) -> None:
    """Refuse a typed option without effect on this config.

    Args:
        cfg: the checked config.
        typed: values by dotted names; the defaults of `conf/` may well hold values that nothing reads.

    Raises:
        UserError: an option is not read.
    """
    for place, node in nodes(cfg):
        for name, why in node.ignored(cfg).items():
            key = f"{place}.{name}".lstrip(".")
            for given, value in typed.items():
                # `explore` without effect covers `algo.explore.start`, but not `algo.explored`.
                if f"{given}.".startswith(f"{key}."):
                    raise UserError(f"{given}={value}: without effect {why}")


def absolute_paths(cfg: Any, folder: Path) -> None:
    """Resolve every path of the config against `folder`, so that a run can be resumed from another one."""
    _each_path(cfg, lambda path: str(folder / path))  # `path` itself where that is absolute


def own_paths(cfg: _T, folder: Path) -> _T:
    """A copy in which paths inside `folder`, of the run, are relative to it: a run may be moved."""
    copied, place = copy.deepcopy(cfg), folder.absolute()

    def relative(path: str) -> str:
        return str(Path(path).relative_to(place)) if Path(path).is_relative_to(place) else path

    _each_path(copied, relative)
    return copied


def by_content(cfg: _T) -> _T:
    """A copy in which the path of a file is followed by a digest of its content: changed, it is another file."""
    copied = copy.deepcopy(cfg)

    def described(path: str) -> str:
        # Refused where it is read, if it cannot be; a folder is known by its name.
        with suppress(OSError):
            if (file := Path(path)).is_file():
                state = file.stat()
                return f"{path} {_digest(path, state.st_mtime_ns, state.st_size)}"
        return path

    _each_path(copied, described)
    return copied


@cache  # of many runs the same
def _digest(path: str, changed_ns: int, size: int) -> str:  # noqa: ARG001
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _each_path(cfg: Any, change: Callable[[str], str]) -> None:
    for _, node in nodes(cfg):
        for name, item in options(type(node)).items():
            value = vars(node)[name]
            # resume=auto is a word, not a file called `auto`.
            if isinstance(item, Option) and item.path and value not in item.words:
                setattr(node, name, _changed(value, change))


def _changed(value: Any, change: Callable[[str], str]) -> Any:
    """A path, or in a list of choices with their options (`kernel.regimes`) each `path`; anything else as it is."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, list):
        return [_changed(each, change) for each in value]
    if isinstance(value, dict) and "path" in value:
        return value | {"path": change(value["path"])}
    return value
