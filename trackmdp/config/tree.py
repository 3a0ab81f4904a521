"""From typed dataclasses to a plain `config.yaml` and back."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf

from trackmdp.config.checks import absolute_paths, build_config, own_paths, validate
from trackmdp.config.options import Option, options
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
