"""A typed config from the files of `conf/`: of Hydra's composition, or without Hydra for the Python functions.

Of a defaults list the second way reads two forms: a choice (``kernel: drift``), and another group's file in the same
place (``/baseline@_here_: qmdp``). Packages, `override` and `experiment` are for the command line alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from trackmdp.config.checks import (
    absolute_paths,
    build_config,
    check_choice,
    check_option,
    refuse_ignored,
    validate,
)
from trackmdp.config.options import GROUPS, Option, leaves, options
from trackmdp.config.registry import choice_values, read_values, resolved
from trackmdp.config.roots import ROOTS
from trackmdp.errors import UserError


def compose(command: str, overrides: Mapping[str, Any] | None = None) -> Any:
    """The checked config of a command with some choices and options replaced.

    Args:
        command: the defaults are those of `conf/<command>.yaml`.
        overrides: choices (``{"algo": "ppo"}``) and options by their dotted names (``{"algo.epochs": 3}``).

    Raises:
        UserError: a name, a type or a range is wrong, or a rule between options is broken.
    """
    typed, schema = dict(_by_option(overrides or {})), ROOTS[command]
    values = command_values(command, typed)
    known = known_options(values, schema)
    # After all choices, so that `algo.epochs` is looked up among the options of the chosen algorithm.
    for key, value in typed.items():
        if key not in GROUPS or key not in options(schema):
            check_option(key, value, known)
            *parents, last = key.split(".")
            node = values
            for parent in parents:
                node = node[parent]
            node[last] = value
    cfg = config_of(values, schema)
    refuse_ignored(cfg, typed)
    return cfg


def command_values(command: str, typed: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a command, and of its choices: those of the defaults list, unless another one is typed.

    Raises:
        UserError: there is no such choice.
    """
    root, schema = read_values(command), ROOTS[command]
    pairs = (entry for entry in root["defaults"] if isinstance(entry, dict))
    chosen = {group: name for pair in pairs for group, name in pair.items()} | dict(typed)
    # The file also has `defaults` and `hydra`, for the command line alone.
    values = {key: value for key, value in root.items() if key in options(schema)}
    for group, item in options(schema).items():
        if isinstance(item, Option) or group not in GROUPS:
            continue
        name = chosen[group]
        names = name if item.several and isinstance(name, list) else [name]
        if name is None and item.optional:
            values[group] = None
            continue
        for each in names:
            check_choice(group, each)
        made = {each: choice_values(group, each) for each in names}
        values[group] = made if item.several else {"name": name} | made[name]
    return values


def composed_values(cfg: DictConfig, schema: type[Any]) -> dict[str, Any]:
    """The values of a composition by Hydra, unresolved, with the name of each choice, which is the type of its node.

    Raises:
        UserError: a file chosen from a group has no schema of the group at its head.
    """
    values: Any = OmegaConf.to_container(cfg, resolve=False)
    values.pop("hydra", None)
    for key, item in options(schema).items():
        if isinstance(item, Option) or not isinstance(values.get(key), dict):
            continue
        node: Any = cfg._get_node(key)
        if item.several:
            for name in values[key]:
                # An entry without a file of the group, such as the one of `+log.mcap.every=2`.
                if OmegaConf.get_type(node, name) is not GROUPS[key].get(name):
                    raise UserError(
                        f"{key}.{name}: not chosen, expected {key}=[NAME,...] with it among the names"
                    )
        elif key in GROUPS:
            # A file of the user's may have any name: the schema at its head decides.
            chosen: Any = OmegaConf.get_type(node)
            if chosen not in GROUPS[key].values():
                names = "|".join(GROUPS[key])
                raise UserError(f"{key}: expected a file that begins with defaults: [{names}]")
            values[key]["name"] = chosen.name
    return dict(values)


def config_of(values: dict[str, Any] | DictConfig, schema: type[Any], *, rules: bool = True) -> Any:
    """The dataclasses of the values, resolved and checked; relative paths are meant from the current folder.

    Args:
        values: of `composed_values`, or of the files.
        schema: of the command.
        rules: whether those between options are checked.

    Raises:
        UserError: an unknown key (also one added with `+`), a missing value, a wrong type, or a broken rule.
    """
    cfg = validate(build_config(resolved(values), schema), rules=rules)
    absolute_paths(cfg, Path.cwd())
    return cfg


def known_options(values: dict[str, Any], schema: type[Any]) -> dict[str, Option]:
    """Dotted key -> option of everything in the config with these choices."""
    return {key: item for key, item, _ in leaves(build_config(values, schema))}


def _by_option(given: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Options by their dotted names; a mapping, as in ``{"algo.entropy": {"start": 0.1}}``, holds those of a node."""
    for name, value in given.items():
        if isinstance(value, Mapping) and value:
            yield from _by_option(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", _plain(value)


def _plain(value: Any) -> Any:
    """A value in the form of a file: numbers and arrays of numpy, tuples and paths become plain ones."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


class Default(NamedTuple):
    """A default in a signature that is stated in `conf/`; `help` shows its value.

    Attributes:
        key: the option, by its dotted name.
        command: of the config.
    """

    key: str
    command: str = "train"

    @property
    def value(self) -> Any:
        """As it stands in `conf/`; of a choice its name."""
        value = attrgetter(self.key)(compose(self.command))
        return getattr(value, "name", value)

    def __repr__(self) -> str:
        return repr(self.value)


default: Any = Default
"""Makes a `Default`; to a type checker it has the type of its parameter."""


def given(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments that are no `Default`."""
    return {name: value for name, value in arguments.items() if not isinstance(value, Default)}
