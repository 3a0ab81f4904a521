"""Resuming a run: its saved config holds, and only the options of `CHANGEABLE` may differ."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trackmdp.config.checks import own_paths, validate
from trackmdp.config.options import GROUPS, SELECTORS, listed, several
from trackmdp.config.roots import TrainConfig
from trackmdp.config.tree import build_config, load_run_config, to_dict, to_yaml
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
"""Options, or groups of them, that may differ on resume: budget, solving, logging, saving, workers and devices."""


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
        _put(saved, key, _look(typed, key))
    # Once more: a new budget may break a rule against an option that was not typed, such as frames per batch.
    resumed: TrainConfig = build_config(saved, TrainConfig)
    validate(resumed)
    return dataclasses.replace(resumed, resume=cfg.resume)


def key_of(word: str) -> str:
    """The dotted key that an override sets."""
    # Hydra's grammar: `algo.epochs=3`, `+key=1` adds, `~key` removes, `group@package=name`, `hydra/launcher=joblib`.
    return word.lstrip("+~").split("=", 1)[0].split("@")[0].replace("/", ".")


def _look(plain: Any, key: str) -> Any:
    """The value at a dotted key; None where the run chose another option of a group, which has no such key."""
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
    value = _look(plain, key)
    if isinstance(value, dict) and several(TrainConfig, key):
        return listed(value)
    return value["name"] if isinstance(value, dict) and "name" in value else value
