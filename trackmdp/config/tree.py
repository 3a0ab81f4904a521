"""From typed dataclasses to a plain `config.yaml`, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf

from trackmdp.config.checks import absolute_paths, check_choice, suggestion, validate
from trackmdp.config.options import GROUPS, ChoiceConfig, Option, as_float, options, several
from trackmdp.config.roots import CommandConfig, TrainConfig, WorldConfig
from trackmdp.config.untrusted import MAX_BYTES, parse_yaml
from trackmdp.errors import UserError
from trackmdp.untrusted import read_text

C = TypeVar("C", bound=CommandConfig)


def to_dict(cfg: Any, *, named: bool = True) -> dict[str, Any]:
    """A plain copy of the config; the option chosen from a group stands under `name`, of several each under its own."""
    # A choice's name is an attribute of its class, no field: without it a saved `kernel: {...}` could not be told from
    # another choice with the same options.
    plain: dict[str, Any] = {"name": cfg.name} if named and hasattr(type(cfg), "name") else {}
    for key in options(type(cfg)):
        value = vars(cfg)[key]
        if several(type(cfg), key):  # {"csv": {"every": 1}}: its name is its key
            plain[key] = {name: to_dict(node, named=False) for name, node in value.items()}
        else:
            plain[key] = to_dict(value) if dataclasses.is_dataclass(value) else value
    return plain


def to_yaml(cfg: Any) -> str:
    """The text of a run's `config.yaml`."""
    return OmegaConf.to_yaml(OmegaConf.create(to_dict(cfg)))


def load_config(file: Path, root: type[C]) -> C:
    """Read back a `config.yaml` written by `to_yaml`, with all checks.

    Raises:
        UserError: there is no such file, or it does not hold a config of this command.
    """
    plain = plain_mapping(read_text(file, most=MAX_BYTES), str(file))
    try:
        typed: C = build_config(plain, root)
        validate(typed)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error
    return typed


def world_of(text: str | bytes) -> WorldConfig:
    """The world that the text of a `config.yaml` describes, whatever command it was written by.

    Raises:
        UserError: it does not describe one.
    """
    plain, known = plain_mapping(text, "config.yaml"), options(WorldConfig)
    # The other keys belong to the command, and each command has its own.
    typed: WorldConfig = build_config({key: value for key, value in plain.items() if key in known}, WorldConfig)
    validate(typed)
    return typed


def plain_mapping(text: str | bytes, source: str) -> dict[str, Any]:
    """The plain mapping in the text of a config, which another version may have written.

    Raises:
        UserError: there is none.
    """
    # Not resolved: every value of a saved config is plain, and `${oc.env:NAME}` in a foreign one must stay a text.
    plain: Any = OmegaConf.to_container(parse_yaml(text, source))
    return {str(key): value for key, value in plain.items()}


def load_run_config(folder: str | Path) -> TrainConfig:
    """The config of a training run.

    Raises:
        UserError: the folder is not that of a run.
    """
    if not Path(folder).is_dir():
        raise UserError(f"run={folder}: no such folder")
    try:
        config = load_config(Path(folder) / "config.yaml", TrainConfig)
    except UserError as error:
        raise UserError(f"run={folder}: not the folder of a run ({error})") from error
    absolute_paths(config, Path(folder).absolute())  # those of the run's own files are relative to it
    return config


def build_config(plain: Any, schema: type[Any], prefix: str = "", group: str = "", named: str = "") -> Any:
    """The dataclasses of a plain config, each choice's schema by its `name`; values are not checked.

    Args:
        plain: the config, or a part of it.
        schema: its dataclass; of a group the base of its choices.
        prefix: of a part, what stands before its keys in messages, such as ``algo.``.
        group: of a choice.
        named: the choice, where it is one of several and its name stands outside.

    Raises:
        UserError: a key is missing or unknown, or a choice is.
    """
    if not isinstance(plain, Mapping):
        raise UserError(f"{prefix.rstrip('.')}={plain}: expected a mapping")
    values = dict(plain)
    if group in GROUPS and issubclass(schema, ChoiceConfig):
        found = values.pop("name", None)
        check_choice(group, named or found)
        schema = GROUPS[group][named or found]
    known = options(schema)
    for key in values:
        if key not in known:
            raise UserError(f"{prefix}{key}: unknown key{suggestion(str(key), known)}")
    for key, described in known.items():
        if key not in values:
            raise UserError(f"{prefix}{key}: missing")
        value, inner = values[key], f"{prefix}{key}."
        if isinstance(described, Option):
            # `reward: 10` in a file is an int to YAML; `type` leaves True alone, which is an int as well, for
            # `validate` to refuse.
            values[key] = as_float(value) if described.kind is float and type(value) is int else value
        elif several(schema, key) and isinstance(value, Mapping):
            values[key] = {
                name: build_config(each, described, f"{inner}{name}.", key, str(name)) for name, each in value.items()
            }
        elif value is not None or several(schema, key):
            values[key] = build_config(value, described, inner, key)
    return schema(**values)
