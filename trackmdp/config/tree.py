"""From typed dataclasses to a plain `config.yaml` and back; and where a run is resumed, its saved config holds."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf

from trackmdp.config.checks import absolute_paths, check_choice, own_paths, suggestion, validate
from trackmdp.config.options import (
    GROUPS,
    SELECTORS,
    ChoiceConfig,
    Option,
    as_float,
    listed,
    optional,
    options,
    several,
)
from trackmdp.config.roots import CommandConfig, TrainConfig, WorldConfig
from trackmdp.config.untrusted import MAX_BYTES, parse_yaml
from trackmdp.errors import UserError
from trackmdp.untrusted import read_text

CHANGEABLE = (
    "collector.total_frames",
    "optimal",
    "evaluation",
    "log",
    "checkpoint",
    "partition.workers",
    "partition.cluster",
    "device",
    "collector.device",
    "quiet",
)
"""Options, or groups of them, that may differ on resume: budget, solving, logging, saving, workers and devices."""

_C = TypeVar("_C", bound=CommandConfig)


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


def flatten(plain: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Every option by its dotted key."""
    found: dict[str, Any] = {}
    for key, value in plain.items():
        found |= flatten(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def to_yaml(cfg: Any) -> str:
    """The text of a run's `config.yaml`."""
    return OmegaConf.to_yaml(OmegaConf.create(to_dict(cfg)))


def load_config(file: Path, root: type[_C]) -> _C:
    """Read back a `config.yaml` written by `to_yaml`, with all checks.

    Raises:
        UserError: there is no such file, or it does not hold a config of this command.
    """
    plain = plain_mapping(read_text(file, most=MAX_BYTES), str(file))
    try:
        typed: _C = build_config(plain, root)
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
        elif value is not None or not optional(schema, key):
            values[key] = build_config(value, described, inner, key)
    return schema(**values)


def fixed_options(cfg: TrainConfig) -> dict[str, Any]:
    """The options by which two runs differ: all but those that may change when a run is resumed."""
    plain = to_dict(cfg)
    for key in (*CHANGEABLE, "resume"):
        *parents, last = key.split(".")
        node = plain
        for name in parents:
            node = node[name]
        node.pop(last)
    return plain


def config_text(cfg: TrainConfig, folder: Path | None) -> str:
    """The text of `config.yaml` in the folder of the run, where it has one: without `resume`, and movable with it."""
    cfg = own_paths(cfg, folder) if folder is not None else cfg
    # With `resume` in it, config.yaml and its digest would differ between a run and the same run interrupted
    # and resumed.
    return to_yaml(dataclasses.replace(cfg, resume=None))


def config_digest(cfg: TrainConfig, folder: Path | None) -> str:
    """SHA-256 of `config.yaml`."""
    return hashlib.sha256(config_text(cfg, folder).encode()).hexdigest()


def run_folder(cfg: TrainConfig, chosen: Path) -> Path:
    """The folder that the run writes to: that of the run it resumes, else `chosen`.

    Raises:
        UserError: `resume` names what is no run, or `chosen` holds a run and `resume` is null.
    """
    if cfg.resume is None:
        if (chosen / "config.yaml").is_file():
            raise UserError(
                f"hydra.run.dir={chosen}: holds a run already; go on with it by resume=auto, or choose another folder"
            )
        return chosen
    if cfg.resume == "auto":
        return chosen
    named = Path(cfg.resume)
    # A checkpoint is RUN/checkpoints/iteration-00000012.pt.
    folder = named.parent.parent if named.is_file() else named
    if not (folder / "config.yaml").is_file():
        raise UserError(f"resume={cfg.resume}: expected auto, the folder of a run, or one of its checkpoints")
    return folder


def continued(cfg: TrainConfig, folder: Path, words: Sequence[str]) -> TrainConfig:
    """The config to run with: where `cfg.resume` asks for it and `folder` holds a run, that of the run.

    Args:
        cfg: what was typed, composed with the defaults.
        folder: of the run.
        words: the overrides that were typed; only these are held against the saved config.

    Raises:
        UserError: an override differs from the saved config and is not in `CHANGEABLE`.
    """
    if cfg.resume is None or not (folder / "config.yaml").is_file():
        return cfg
    saved, typed = to_dict(load_run_config(folder)), to_dict(cfg)
    # Choices before their options: log.mcap.episodes=3 log=[mcap] first brings the mcap to set it in.
    for key, word in sorted(((key_of(word), word) for word in words), key=lambda pair: "." in pair[0]):
        if key.split(".")[0] in ("hydra", "resume"):
            continue
        old, new = _told(saved, key), _told(typed, key)
        if key in SELECTORS:
            # `credit` is no option of the config: the algorithm that was chosen knows its own.
            chosen = GROUPS[SELECTORS[key].group][saved[SELECTORS[key].group]["name"]]
            old, new = getattr(chosen, key), word.partition("=")[2]
        if old == new:
            continue
        # With the dot, so that `log` allows `log.csv.every` but not an option that merely begins with these
        # letters.
        if not any(key == allowed or key.startswith(f"{allowed}.") for allowed in CHANGEABLE):
            old, new = ("null" if each is None else each for each in (old, new))
            raise UserError(f"{key}: the run has {old}, typed was {new}; it cannot change on resume")
        _put(saved, key, at_key(typed, key))
    # Once more: a new budget may break a rule against an option that was not typed, such as frames per batch.
    resumed: TrainConfig = build_config(saved, TrainConfig)
    validate(resumed)
    return dataclasses.replace(resumed, resume=cfg.resume)


def key_of(word: str) -> str:
    """The dotted key that an override sets."""
    # Hydra's grammar: `algo.epochs=3`, `+key=1` adds, `~key` removes, `group@package=name`, `hydra/launcher=joblib`.
    return word.lstrip("+~").split("=", 1)[0].split("@")[0].replace("/", ".")


def at_key(plain: Any, key: str) -> Any:
    """The value at a dotted key of nested dicts; None where there is no such key, as of another choice of a group."""
    for name in key.split("."):
        plain = plain.get(name) if isinstance(plain, dict) else None
    return plain


def _put(plain: dict[str, Any], key: str, value: Any) -> None:
    """Set a changed option; of several choices those that the run has keep their values.

    Raises:
        UserError: it is an option of a choice that the run has not made.
    """
    *parents, last = key.split(".")
    for name in parents:
        if name not in plain:
            names = listed([*plain, name])
            raise UserError(f"{key}: the run has {parents[0]}={listed(plain)}, expected {parents[0]}={names} beside it")
        plain = plain[name]
    if several(TrainConfig, key):
        value = {name: plain[last].get(name, own) for name, own in value.items()}
    plain[last] = value


def _told(plain: dict[str, Any], key: str) -> Any:
    """The value at a dotted key, of choices their names: their own options are compared where those are typed."""
    value = at_key(plain, key)
    if isinstance(value, dict) and several(TrainConfig, key):
        return listed(value)
    return value["name"] if isinstance(value, dict) and "name" in value else value
