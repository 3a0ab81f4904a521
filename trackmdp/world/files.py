"""Tables of numbers that a user hands over in a file."""

from __future__ import annotations

import os
import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from trackmdp.errors import UserError
from trackmdp.world.model import Array

__all__ = ["read_columns", "read_numbers"]


def read_numbers(key: str, path: str | Path, *, name: str) -> Array:
    """The numbers in a .npy, .npz (its only array, or the one called `name`) or .csv file; nothing is unpickled.

    Raises:
        UserError: there is no such file, or it does not hold real numbers; `key` is named as the option at fault.
    """
    with _opened(f"{key}={path}", Path(path)) as stream:
        table = _read(f"{key}={path}", Path(path).suffix, stream, name)
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "biuf":
        raise UserError(f"{key}={path}: not a table of numbers (but of {getattr(table, 'dtype', type(table))})")
    return table.astype(np.float64)


def read_columns(key: str, path: str | Path) -> dict[str, Array]:
    """The columns of a .csv file under the names in its first line, or the arrays of an .npz; nothing is unpickled.

    Raises:
        UserError: there is no such file, or it does not hold columns of real numbers, all of one length.
    """
    source, suffix = f"{key}={path}", Path(path).suffix
    if suffix not in (".csv", ".npz"):
        raise UserError(f"{source}: expected a .csv or .npz file")
    with _opened(source, Path(path)) as stream:
        columns = _csv_columns(stream) if suffix == ".csv" else _npz_columns(stream)
    for name, column in columns.items():
        if column.dtype.kind not in "iuf" or column.ndim != 1:
            raise UserError(f"{source}: {name} is not a column of numbers (but {column.dtype}, shape {column.shape})")
    if len({len(column) for column in columns.values()}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
        raise UserError(f"{source}: columns of different lengths ({lengths})")
    return {name: column.astype(np.float64) for name, column in columns.items()}


@contextmanager
def _opened(source: str, file: Path) -> Iterator[BinaryIO]:
    """The file, open; what goes wrong with it ends in one line that begins with `source`."""
    if not file.is_file():
        raise UserError(f"{source}: no such file")
    try:
        with warnings.catch_warnings(action="error"), file.open("rb") as stream:  # numpy only warns of an empty .csv
            yield stream
    except UserError:
        raise
    except (OSError, ValueError, TypeError, EOFError, KeyError, UserWarning, zipfile.BadZipFile) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{source}: not a table of numbers ({reason})") from error


def _csv_columns(stream: BinaryIO) -> dict[str, np.ndarray]:
    names = [name.strip() for name in stream.readline().decode("utf-8-sig").split(",")]
    if len(set(names)) < len(names):
        raise ValueError(f"two columns of one name in {','.join(names)}")
    if not stream.read(1):
        return {name: np.zeros(0) for name in names}
    stream.seek(-1, os.SEEK_CUR)
    table = np.loadtxt(stream, delimiter=",", ndmin=2, comments=None)
    if table.shape[1] != len(names):
        raise ValueError(f"{len(names)} names in the first line, but {table.shape[1]} columns")
    return dict(zip(names, table.T, strict=True))


def _npz_columns(stream: BinaryIO) -> dict[str, np.ndarray]:
    with np.load(stream, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


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
