"""From a composed config to one that can be run: every check that comes before the first folder is made."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig

from trackmdp.config import (
    ROOTS,
    CommandConfig,
    EvaluateConfig,
    ExportConfig,
    ReportConfig,
    WorldConfig,
    from_hydra,
    load_run,
)
from trackmdp.errors import UserError

__all__ = ["announce", "check_files", "say", "shown", "typed_config"]

WORLD_KEYS = ("grid", "kernel", "cost")


def typed_config(command: str, cfg: DictConfig, folder: Path) -> CommandConfig:
    """The typed config with every check that needs no file; relative paths are those of `folder`.

    Raises:
        UserError: an option is unknown or not allowed.
    """
    if "hydra" in cfg:
        cfg = cfg.copy()
        cfg._set_flag("struct", False)
        del cfg["hydra"]
    return from_hydra(cfg, ROOTS[command], folder)


def check_files(cfg: CommandConfig, task: Sequence[str]) -> None:
    """Check what the config names: runs, sweeps, tables of motion and prices.

    Args:
        cfg: the typed config.
        task: the overrides that were typed.

    Raises:
        UserError: what is named is not there, or not what is expected.
    """
    if isinstance(cfg, EvaluateConfig) and cfg.run is not None:
        for word in task:
            key = word.lstrip("+~").split("=")[0]
            if key.split(".")[0].split("@")[0] in WORLD_KEYS:
                raise UserError(f"{word}: not together with run={cfg.run}, whose own world is used")
        load_run(cfg.run)
    elif isinstance(cfg, ExportConfig):
        load_run(cfg.run)
    elif isinstance(cfg, ReportConfig) and not Path(cfg.sweep).is_dir():
        raise UserError(f"sweep={cfg.sweep}: no such folder")
    elif isinstance(cfg, WorldConfig) and _reads_files(cfg):
        from trackmdp.build import make_problem

        make_problem(cfg)


def announce(command: str, cfg: CommandConfig, folder: Path, label: str = "") -> None:
    """The first line at the terminal, before anything heavy is imported; `label` goes before it in brackets."""
    if cfg.quiet or not isinstance(cfg, WorldConfig):
        return
    label = f"({label}) " if label else ""
    what = next((getattr(cfg, name).name for name in ("algo", "baseline", "solver") if getattr(cfg, name, None)), "")
    if isinstance(cfg, EvaluateConfig) and cfg.run is not None:
        say(f"{label}evaluate {cfg.run} -> {shown(folder)}")
        return
    n = cfg.grid.size
    seed = f", seed {cfg.seed}" if hasattr(cfg, "seed") else ""
    where = f"on a {n}x{n} grid, T_max {cfg.grid.t_max}, kernel {cfg.kernel.name}{seed}"
    say(label + " ".join(f"{command} {what} {where} -> {shown(folder)}".split()))


def shown(folder: Path) -> Path:
    """The folder as seen from the current one, where it lies in it."""
    return folder.relative_to(Path.cwd()) if folder.is_absolute() and folder.is_relative_to(Path.cwd()) else folder


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _reads_files(cfg: WorldConfig) -> bool:
    """Whether building the world can still fail: it is read from files, or its target may never exit."""
    exits = getattr(cfg.kernel, "exit_probability", 0.0) > 1e-9
    return not exits or isinstance(getattr(cfg.cost, "sensor", None), str)
