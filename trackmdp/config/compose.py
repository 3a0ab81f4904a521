"""A typed config from the files of `conf/`: by Hydra, or without it, where the Python functions take their defaults.

Of Hydra's defaults lists it reads what the files of this package and of its plugins use: a schema (``base_ppo``), a
choice (``kernel: drift``), and another group's file in the same place (``/baseline@_here_: qmdp``), whose name may
contain a selector (``${credit}/ppo``). Packages, `override` and `experiment` are for the command line alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf

from trackmdp.config.checks import absolute_paths, check_choice, check_option, refuse_ignored, validate
from trackmdp.config.options import GROUPS, SELECTORS, Option, optional, options, several
from trackmdp.config.registry import choice_values, read_values, resolved
from trackmdp.config.roots import ROOTS, CommandConfig
from trackmdp.config.tree import build_config
from trackmdp.errors import UserError

_C = TypeVar("_C", bound=CommandConfig)


def compose(command: str, overrides: Mapping[str, Any] | None = None, *, folder: Path | None = None) -> Any:
    """The checked config of a command with some choices and options replaced.

    Args:
        command: whose `conf/<command>.yaml` is read.
        overrides: choices (``{"algo": "ppo"}``) and options by their dotted names (``{"algo.epochs": 3}``).
        folder: what relative paths are relative to; by default the current folder.

    Raises:
        UserError: a name, a type or a range is wrong, or a rule between options is broken.
    """
    typed = dict(_by_option(overrides or {}))
    root = read_values(command)
    schema = ROOTS[command]
    chosen = _chosen(root, schema, typed)
    # Only what the schema names: the files of the commands also have `defaults` and `hydra`, which are for the
    # command line.
    values: dict[str, Any] = {key: value for key, value in root.items() if key in options(schema)}
    for group, name in chosen.items():
        if isinstance(name, list):
            values[group] = {each: choice_values(group, each, chosen) for each in name}
        elif group in options(schema):
            values[group] = None if name is None else choice_values(group, name, chosen)
    known = dict(known_options(schema, values))
    # After all choices are merged, so that `algo.epochs` is looked up among the options of the algorithm that
    # was chosen.
    for key, value in typed.items():
        if key not in chosen:
            _put(values, key, value, known)
    cfg = _typed(values, known, schema, folder or Path.cwd())
    refuse_ignored(cfg, typed, chosen)
    return cfg


def from_hydra(cfg: DictConfig, root: type[_C], folder: Path) -> _C:
    """The typed, checked config of what Hydra composed; relative paths are resolved against `folder`.

    Raises:
        UserError: an unknown key (even one added with `+`), a missing value, a wrong type, or a broken rule.
    """
    values = composed_values(cfg, root)
    return _typed(values, dict(known_options(root, values)), root, folder)


def composed_values(cfg: DictConfig, schema: type[Any]) -> dict[str, Any]:
    """The values that Hydra composed, unresolved, the name of each choice, which is its node's type, beside its own."""
    values: Any = OmegaConf.to_container(cfg, resolve=False)
    values.pop("hydra", None)  # no schema has it
    for key, value in values.items():
        if not isinstance(value, dict) or key not in options(schema):
            continue
        node: Any = cfg._get_node(key)
        if several(schema, key):
            for name in value:
                # An entry that no file of the group made, such as that of `+log.mcap.every=2`.
                if OmegaConf.get_type(node, name) is not GROUPS[key].get(name):
                    raise UserError(f"{key}.{name}: not chosen, expected {key}=[NAME,...] with it among the names")
        elif name := getattr(OmegaConf.get_type(node), "name", None):
            value["name"] = name
    return dict(values)


def _typed(values: dict[str, Any], known: Mapping[str, Option], schema: type[Any], folder: Path) -> Any:
    """The checked dataclasses of the values, their interpolations resolved."""
    cfg = build_config(resolved(values, known), schema)
    validate(cfg)
    absolute_paths(cfg, folder)
    return cfg


class Default:
    """A default in a signature that is taken from `conf/`, where it is stated once; `help` shows its value.

    Args:
        key: the option, by its dotted name.
        command: whose config has it.
    """

    def __init__(self, key: str, command: str = "train") -> None:
        self.key, self.command = key, command

    def __repr__(self) -> str:
        value = attrgetter(self.key)(compose(self.command))
        return repr(getattr(value, "name", value))


def default(key: str, command: str = "train") -> Any:
    """A `Default`; to a type checker it is of the type of the parameter it stands for."""
    return Default(key, command)


def given(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments that are no `Default`."""
    return {name: value for name, value in arguments.items() if not isinstance(value, Default)}


def _chosen(root: Mapping[str, Any], schema: type[Any], typed: Mapping[str, Any]) -> dict[str, Any]:
    """Group or selector -> its choice, or list of choices: that of the defaults list, unless another is given."""
    chosen: dict[str, Any] = {}
    # An entry is a text (`base_train`, `_self_`, `hydra/folders`) or one pair (`kernel: random_support`); of
    # the pairs, `experiment: null` and `override hydra/sweeper: ...` are neither a selector nor an option of
    # the schema.
    for entry in root["defaults"]:
        pairs = entry.items() if isinstance(entry, dict) else ()
        chosen |= {key: name for key, name in pairs if key in SELECTORS or key in options(schema)}
    for group in chosen:
        if group not in typed:
            continue
        name = typed[group]
        many = several(schema, group)
        names = name if many and isinstance(name, list) else [name]
        for each in names:
            if each is not None or not optional(schema, group):
                check_choice(group, each)
        chosen[group] = names if many else name
    return chosen


def known_options(schema: type[Any], values: Any, prefix: str = "") -> Iterator[tuple[str, Option]]:
    """Dotted key -> option of all that the config with these choices has."""
    for name, item in options(schema).items():
        if isinstance(item, Option):
            yield f"{prefix}{name}", item
            continue
        # A group that is null (`baseline: null`) has no options.
        inner = values.get(name) if values else None
        if inner is not None and several(schema, name):
            for each, values_of_each in inner.items():
                yield from known_options(GROUPS[name][each], values_of_each, f"{prefix}{name}.{each}.")
        elif isinstance(inner, dict):  # `~kernel` leaves "???", which is refused as missing
            if name in GROUPS and inner.get("name") not in GROUPS[name]:  # of a file that begins with no choice of ours
                raise UserError(f"{name}: expected a file that begins with defaults: [{'|'.join(GROUPS[name])}]")
            yield from known_options(GROUPS[name][inner["name"]] if name in GROUPS else item, inner, f"{prefix}{name}.")


def _by_option(given: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Options by their dotted names; a mapping, as in ``{"algo.entropy": {"start": 0.1}}``, holds those of a node."""
    for name, value in given.items():
        if isinstance(value, Mapping):
            yield from _by_option(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", _plain(value)


def _put(values: dict[str, Any], key: str, value: Any, known: Mapping[str, Option]) -> None:
    """Set the option `key`, checked."""
    check_option(key, value, known)
    *parents, last = key.split(".")
    for parent in parents:
        values = values[parent]
    values[last] = value


def _plain(value: Any) -> Any:
    """A value as it would be read from a file: numpy's numbers and arrays, tuples and paths become plain ones."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
