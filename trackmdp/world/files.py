"""Tables of numbers that a user hands over in a file."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from trackmdp.errors import UserError
from trackmdp.world.model import Array

__all__ = ["read_numbers"]


def read_numbers(key: str, path: str | Path, *, name: str) -> Array:
    """The numbers in a .npy, .npz (its only array, or the one called `name`) or .csv file; nothing is unpickled.

    Raises:
        UserError: there is no such file, or it does not hold real numbers; `key` is named as the option at fault.
    """
    file = Path(path)
    if not file.is_file():
        raise UserError(f"{key}={path}: no such file")
    try:
        with warnings.catch_warnings(action="error"), file.open("rb") as stream:  # numpy only warns of an empty .csv
            table = _read(f"{key}={path}", file.suffix, stream, name)
    except UserError:
        raise
    except (OSError, ValueError, TypeError, EOFError, KeyError, UserWarning, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{key}={path}: not a table of numbers ({reason})") from error
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "biuf":
        raise UserError(f"{key}={path}: not a table of numbers (but of {getattr(table, 'dtype', type(table))})")
    return table.astype(np.float64)


def _read(source: str, suffix: str, stream: BinaryIO, name: str) -> Any:
    if suffix == ".npy":
        return np.load(stream, allow_pickle=False)
    if suffix == ".npz":
        with np.load(stream, allow_pickle=False) as archive:
            names = archive.files
            if name not in names and len(names) != 1:
                raise UserError(f"{source}: expected one array or one called '{name}', found {names}")
            return archive[name if name in names else names[0]]
    if suffix == ".csv":
        return np.loadtxt(stream, delimiter=",", ndmin=2)
    raise UserError(f"{source}: expected a .npy, .npz or .csv file")
