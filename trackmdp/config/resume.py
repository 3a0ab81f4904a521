"""The config of a run that is resumed: the saved one, with the typed changes that are allowed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from trackmdp.config.checks import build_config, validate
from trackmdp.config.options import listed, several
from trackmdp.config.roots import TrainConfig
from trackmdp.config.tree import load_run_config, to_dict
from trackmdp.errors import UserError

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
"""Options, or groups of them, that may differ on resume: budget, solving, logging, saving, workers, and devices of the
same kind."""


def run_folder(cfg: TrainConfig, chosen: Path, key: str = "hydra.run.dir") -> Path:
    """The folder of the run: of the one that it resumes, else `chosen`, which the option `key` names.

    Raises:
        UserError: `resume` names no run, or `chosen` holds a run and `resume` is null.
    """
    if cfg.resume is None and (chosen / "config.yaml").is_file():
        raise UserError(
            f"{key}={chosen}: holds a run already; resume it by resume=auto, or choose another folder"
        )
    if cfg.resume in (None, "auto"):
        return chosen
    named = Path(str(cfg.resume))
    # A checkpoint is RUN/checkpoints/iteration-00000012.pt.
    folder = named.parent.parent if named.is_file() else named
    if not (folder / "config.yaml").is_file():
        raise UserError(
            f"resume={cfg.resume}: expected auto, the folder of a run, or one of its checkpoints"
        )
    return folder


def fixed_options(cfg: TrainConfig) -> dict[str, Any]:
    """The options by which two runs differ: all but the ones that may change when a run is resumed."""
    plain = to_dict(cfg)
    for key in (*CHANGEABLE, "resume"):
        parent, _, last = key.rpartition(".")
        (at_key(plain, parent) if parent else plain).pop(
            last
        )  # all keys are there: the config is typed
    return plain


def continued(cfg: TrainConfig, folder: Path, words: Sequence[str]) -> TrainConfig:
    """The config to run with: the saved one, where `cfg.resume` asks for it and `folder` holds a run.

    Args:
        cfg: typed and composed with the defaults.
        folder: of the run.
        words: the typed overrides; only these are compared with the saved config.

    Raises:
        UserError: an override differs from the saved config and is not in `CHANGEABLE`.
    """
    if cfg.resume is None or not (folder / "config.yaml").is_file():
        return validate(cfg)
    saved, typed = to_dict(load_run_config(folder)), to_dict(cfg)
    # Choices before their options: log.mcap.episodes=3 log=[mcap] first adds the mcap.
    for key in sorted(map(key_of, words), key=lambda key: "." in key):
        old, new = (_named(at_key(plain, key), key) for plain in (saved, typed))
        if key.split(".")[0] in ("hydra", "resume") or old == new:
            continue
        # With the dot: `log` allows `log.csv.every`, and no option that merely begins with these letters.
        if not any(f"{key}.".startswith(f"{allowed}.") for allowed in CHANGEABLE):
            old, new = ("null" if each is None else each for each in (old, new))
            raise UserError(
                f"{key}: the run has {old}, typed was {new}; it cannot change on resume"
            )
        _put(saved, key, at_key(typed, key))
    # Checked again: a new budget may break a rule against an option that was not typed, as frames per batch.
    resumed = validate(build_config(saved, TrainConfig))
    return dataclasses.replace(resumed, resume=cfg.resume)


def key_of(word: str) -> str:
    """The dotted key that an override sets."""
    # Hydra's grammar: `algo.epochs=3`, `+key=1` adds, `~key` removes, `group@package=name`, `hydra/launcher=joblib`.
    return word.lstrip("+~").split("=", 1)[0].split("@")[0].replace("/", ".")


def by_key(words: Iterable[str]) -> dict[str, str]:
    """The text of each key's value, as typed."""
    return {key_of(word): word.partition("=")[2] for word in words}


def at_key(plain: Any, key: str) -> Any:
    """The value at a dotted key of nested dicts; None where there is no such key, as of another choice of a group."""
    for name in key.split("."):
        plain = plain.get(name) if isinstance(plain, dict) else None
    return plain


def _put(plain: dict[str, Any], key: str, value: Any) -> None:
    """Set a changed option; of several choices those of the run keep their values.

    Raises:
        UserError: it is an option of a choice that the run does not have.
    """
    *parents, last = key.split(".")
    for name in parents:
        if name not in plain:
            names = listed([*plain, name])
            raise UserError(
                f"{key}: the run has {parents[0]}={listed(plain)}, expected {parents[0]}={names} beside it"
            )
        plain = plain[name]
    if several(TrainConfig, key):
        value = {name: plain[last].get(name, own) for name, own in value.items()}
    plain[last] = value


def _named(value: Any, key: str) -> Any:
    """The name or names of a choice, anything else as it is: options of a choice are compared where they are typed."""
    if not isinstance(value, dict):
        return value
    return listed(value) if several(TrainConfig, key) else value.get("name", value)
