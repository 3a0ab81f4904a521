"""From typed dataclasses to a plain `config.yaml` and back."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import MISSING, OmegaConf

from trackmdp.config.checks import absolute_paths, check_choice, own_paths, suggestion, validate
from trackmdp.config.option_fields import Option, as_float
from trackmdp.config.options import GROUPS, Node, options
from trackmdp.config.roots import CommandConfig, TrainConfig
from trackmdp.errors import UserError
from trackmdp.untrusted import parse_yaml, read_text

_C = TypeVar("_C", bound=CommandConfig)
_T = TypeVar("_T")


def to_dict(cfg: Any) -> dict[str, Any]:
    """A plain copy of the config; a choice has its `name` beside its options, each of several is under its name."""
    plain: dict[str, Any] = {"name": cfg.name} if hasattr(type(cfg), "name") else {}
    for key, item in options(type(cfg)).items():
        value = vars(cfg)[key]
        if isinstance(item, Option) or value is None:
            plain[key] = value
        elif item.several:  # {"csv": {"every": 1}}
            plain[key] = {
                name: {own: each for own, each in to_dict(node).items() if own != "name"}
                for name, node in value.items()
            }
        else:
            plain[key] = to_dict(value)
    return plain


def flatten(plain: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Every option by its dotted key."""
    found: dict[str, Any] = {}
    for key, value in plain.items():
        inner = isinstance(value, Mapping)
        found |= flatten(value, f"{prefix}{key}.") if inner else {f"{prefix}{key}": value}
    return found


def to_yaml(cfg: Any) -> str:
    """The text of a run's `config.yaml`."""
    return OmegaConf.to_yaml(OmegaConf.create(to_dict(cfg)))


def config_text(cfg: TrainConfig, folder: Path | None) -> str:
    """The text of `config.yaml` in the folder of the run: without `resume`, with its own files relative to it."""
    cfg = own_paths(cfg, folder) if folder is not None else cfg
    # With `resume` the text would differ between a run and the same run interrupted and resumed.
    return to_yaml(dataclasses.replace(cfg, resume=None))


def config_digest(cfg: TrainConfig, folder: Path | None) -> str:
    """SHA-256 of `config.yaml`."""
    return hashlib.sha256(config_text(cfg, folder).encode()).hexdigest()


def load_config(file: Path, root: type[_C]) -> _C:
    """Read back a `config.yaml` of `to_yaml`, with all checks.

    Raises:
        UserError: there is no such file, or no config of this command in it.
    """
    plain = parse_yaml(read_text(file), str(file))
    try:
        return validate(build_config(plain, root))
    except UserError as error:
        raise UserError(f"{file}: {error}") from error


def train_config_of(text: str | bytes) -> TrainConfig:
    """The config of a training run in the text of its `config.yaml`.

    Raises:
        UserError: there is none.
    """
    return validate(build_config(parse_yaml(text, "config.yaml"), TrainConfig))


def load_run_config(folder: str | Path) -> TrainConfig:
    """The config of a training run.

    Raises:
        UserError: the folder is not of a run.
    """
    if not Path(folder).is_dir():
        raise UserError(f"run={folder}: no such folder")
    try:
        config = load_config(Path(folder) / "config.yaml", TrainConfig)
    except UserError as error:
        raise UserError(f"run={folder}: not the folder of a run ({error})") from error
    absolute_paths(config, Path(folder).absolute())
    return config


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
            raise UserError(f"{prefix}{key}: unknown key{suggestion(str(key), known)}")
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
