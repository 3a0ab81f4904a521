"""Output folders: made once everything is checked, removed again if nothing was written to them."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable
from pathlib import Path

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from trackmdp.errors import UserError


def folder_of(cfg: DictConfig, key: str) -> Path:
    """The folder at a dotted key, such as ``hydra.run.dir``, its interpolations resolved.

    Raises:
        UserError: it is missing or no folder's name, or an interpolation in it leads nowhere.
    """
    try:
        # `select` gives None for a missing key, but raises for "???" only where it is told to.
        value = OmegaConf.select(cfg, key, throw_on_missing=True)
    except MissingMandatoryValue:
        value = None
    except Exception as error:  # a resolver of `${name:...}` raises what it likes
        said = str(error).strip().splitlines() or [type(error).__name__]
        raise UserError(f"{key}: {said[0]}") from error
    if not isinstance(value, str):
        raise UserError(f"{key}: missing, expected a folder")
    folder = Path(value)
    try:
        # Asked for its error alone: a name that is too long, or a folder that may not be looked into, is refused here
        # in one line.
        folder.exists()
    except OSError as error:
        raise UserError(f"{key}={value}: expected a folder that can be written to ({error.strerror})") from error
    return folder


def make_folder(key: str, folder: Path) -> list[Path]:
    """Make `folder`; returns the folders that were not there before, the innermost first.

    Raises:
        UserError: it cannot be made or written to. Nothing is left behind then.
    """
    # Noted before anything is made, so that exactly these are taken away again.
    path = folder.absolute()
    made = [each for each in (path, *path.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A folder that was there already may be read-only: mkdir does not complain, the first file would.
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, "it cannot be written to")
    except OSError as error:
        remove_if_empty(made)
        raise UserError(f"{key}={folder}: expected a folder that can be written to ({error.strerror})") from error
    return made


def remove_if_empty(folders: Iterable[Path]) -> None:
    """Remove the folders, in this order, up to the first that is not empty."""
    for folder in folders:
        try:
            folder.rmdir()
        except FileNotFoundError:
            continue
        except OSError:
            return
