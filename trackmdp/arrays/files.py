"""Tables of numbers in .npy, .npz and .csv files, read within the limits of `trackmdp.untrusted`."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from scipy import sparse

from trackmdp.arrays.numbers import Range, one_each
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.grid.size import Size, grid_size
from trackmdp.untrusted import LARGE, decoded, load_npy, load_npz, opened

_LONGEST_TEXT, _LONGEST_HEAD = 2**30, 2**16
"""Bytes of the longest .csv file, a recording of some eighty million steps, and of its first line."""

_T = TypeVar("_T")
_CSR = {"data", "indices", "indptr", "shape"}


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """The content of an `.npz` file; the same arrays, the same bytes."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def per_cell(
    key: str,
    given: float | list[float] | str,
    size: Size,
    allowed: Range,
    sensors: int | None = None,
) -> Array:
    """`[M]` one number per cell, or `[S]` per sensor: one for all, a list, or the content of a file.

    Args:
        key: the option, for messages.
        given: a number, a list, or a path as in `read_numbers`.
        size: of the grid.
        allowed: the test for numbers in range, and the range in words.
        sensors: S, where the numbers are those of sensors with footprints.

    Raises:
        UserError: a list or file is missing or malformed, holds another number of numbers, or one out of range.
    """
    count, each = (grid_size(size), "cell") if sensors is None else (sensors, "sensor")
    if not isinstance(given, str):
        return one_each(key, given, count, each, allowed)
    values = read_numbers(key, given, name=key.rpartition(".")[2])
    # A row or a column of numbers in a .csv file is a list.
    values = values.ravel() if 1 in values.shape else values
    return one_each(f"{key}={given}", values, count, each, allowed)


def read_numbers(key: str, path: str | Path, *, name: str) -> Array:
    """The numbers in a .npy, .npz (its only array, or the one called `name`) or .csv file.

    Raises:
        UserError: there is no such file, or it does not hold real numbers; `key` is named as the option at fault.
    """
    table = read_matrix(key, path, name=name)
    if sparse.issparse(table):
        raise UserError(f"{key}={path}: a sparse matrix, expected a table of numbers")
    return table


def read_matrix(key: str, path: str | Path, *, name: str) -> sparse.csr_array | Array:
    """The table in a file of `read_numbers`, or the CSR matrix in an .npz as `scipy.sparse.save_npz` writes it.

    Raises:
        UserError: there is no such file, or it holds no real numbers, or no matrix.
    """
    source, file = f"{key}={path}", Path(path)
    if file.suffix not in _READERS:
        raise UserError(f"{source}: expected a .npy, .npz or .csv file")
    with _opened(source, file) as stream:
        found = _READERS[file.suffix](stream)
        if isinstance(found, dict):
            found = _only_one(found, name)
    if found.dtype.kind not in "biuf":
        raise UserError(f"{source}: not a table of numbers (but of {found.dtype})")
    return found.astype(np.float64)


def _only_one(arrays: dict[str, Any], name: str) -> sparse.csr_array | Array:
    """The matrix in an .npz, or its one array, or the one called `name`."""
    if arrays.keys() >= _CSR:
        return csr_of(arrays)
    if name not in arrays and len(arrays) != 1:
        raise UserError(f"expected one array or one called '{name}', found {list(arrays)[:9]}")
    return arrays[name if name in arrays else next(iter(arrays))]


def csr_of(arrays: Mapping[str, np.ndarray]) -> sparse.csr_array:
    """The CSR matrix of float64 with the arrays `data`, `indices`, `indptr` and `shape`.

    Raises:
        ValueError: they do not fit together.
    """
    if str(np.asarray(arrays.get("format", "csr")).astype(str)) != "csr":
        raise ValueError("a sparse matrix of another format than csr")
    if arrays["data"].dtype.kind not in "biuf" or arrays["shape"].dtype.kind not in "iu":
        raise ValueError("a sparse matrix of other values than numbers")
    rows, columns = (int(side) for side in arrays["shape"])  # ValueError where there are not two
    data = arrays["data"].astype(np.float64)
    return whole_csr(data, arrays["indices"], arrays["indptr"], (rows, columns))


def whole_csr(data: Any, indices: Any, indptr: Any, shape: tuple[int, int]) -> sparse.csr_array:
    """The CSR matrix of arrays from a file: with indices out of `shape` SciPy would read outside its memory.

    Raises:
        ValueError: they do not fit together, or lead out of `shape`.
    """
    if not indices.dtype.kind == indptr.dtype.kind == "i":  # SciPy would cut others to integers
        raise ValueError("a sparse matrix with indices that are not whole numbers")
    matrix = sparse.csr_array((data, indices, indptr), shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def read_columns(key: str, path: str | Path, *, ids: str) -> tuple[dict[str, Array], list[str]]:
    """The columns of a .csv file under the names in its first line, or the arrays of an .npz; and the texts of `ids`.

    Args:
        key: the option, for messages.
        path: the file.
        ids: a column that may hold texts, which are numbered 0, 1 ... in sorted order; of numbers there are none.

    Raises:
        UserError: there is no such file, or it does not hold columns of real numbers, all of one length.
    """
    source, suffix = f"{key}={path}", Path(path).suffix
    if suffix not in (".csv", ".npz"):
        raise UserError(f"{source}: expected a .csv or .npz file")
    with _opened(source, Path(path)) as stream:
        columns, texts = _csv_columns(stream, ids) if suffix == ".csv" else (load_npz(stream), [])
    if ids in columns and columns[ids].dtype.kind == "U" and columns[ids].ndim == 1:
        found, columns[ids] = np.unique(columns[ids], return_inverse=True)
        texts = found.tolist()
    for name, column in columns.items():
        if column.dtype.kind not in "iuf" or column.ndim != 1:
            raise UserError(
                f"{source}: {name} is not a column of numbers (but {column.dtype}, shape {column.shape})"
            )
    if len({len(column) for column in columns.values()}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
        raise UserError(f"{source}: columns of different lengths ({lengths})")
    return {name: column.astype(np.float64) for name, column in columns.items()}, texts


def once(read: Callable[..., _T], path: str | Path, *how: Hashable) -> _T:
    """`read(path, *how)`, kept until the file changes: a run is checked before its folder is made, and asks again."""
    try:
        found = Path(path).stat()
        stamp = found.st_mtime_ns, found.st_size, found.st_ino
    except OSError:
        stamp = None
    return _kept(read, path, how, stamp)


@lru_cache(maxsize=1)
def _kept(read: Callable[..., Any], path: str | Path, how: tuple[Hashable, ...], stamp: Any) -> Any:  # noqa: ARG001
    """See `once`; `stamp` changes with the file."""
    return read(path, *how)


def column_names(key: str, path: str | Path) -> list[str]:
    """The names in the first line of a .csv file.

    Raises:
        UserError: there is no such file, or its first line is not text.
    """
    with _opened(f"{key}={path}", Path(path)) as stream:
        return first_line(stream)


def first_line(stream: BinaryIO) -> list[str]:
    """The names in the first line of a .csv file, which is read."""
    line = stream.readline(_LONGEST_HEAD)
    if len(line) == _LONGEST_HEAD:
        raise ValueError(f"a first line of more than {_LONGEST_HEAD:,} bytes")
    names = [name.strip().strip('"') for name in line.decode("utf-8-sig").split(",")]
    if len(names) == 1 and (";" in names[0] or "\t" in names[0]):
        raise ValueError(f"{names[0][:80]!r}: expected commas between columns")
    return names


@contextmanager
def _opened(source: str, file: Path) -> Iterator[BinaryIO]:
    """The file, open; its errors end in one line that begins with `source`."""
    most = _LONGEST_TEXT if file.suffix == ".csv" else LARGE
    with (
        # The user named this very file, so it may be a link: data sets on a cluster often are.
        opened(file, most=most, source=source, links=True) as stream,
        decoded(source, "a table of numbers"),
        warnings.catch_warnings(action="error"),  # numpy only warns of an empty .csv
    ):
        yield stream


def _csv_columns(stream: BinaryIO, ids: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """See `read_columns`."""
    names = first_line(stream)
    if len(set(names)) < len(names):
        raise ValueError(f"two columns of one name in {','.join(names)[:80]}")
    if not stream.read(1):
        return {name: np.zeros(0) for name in names}, []
    stream.seek(-1, os.SEEK_CUR)
    here, texts = stream.tell(), list[str]()
    try:
        table = _csv(stream, comments=None)
    except ValueError:
        if ids not in names:
            raise
        stream.seek(here)
        table, texts = _csv_of_texts(stream, names.index(ids))
    if table.shape[1] != len(names):
        raise ValueError(f"{len(names)} names in the first line, but {table.shape[1]} columns")
    return dict(zip(names, table.T, strict=True)), texts


def _csv_of_texts(stream: BinaryIO, column: int) -> tuple[Array, list[str]]:
    """The lines that are left, the texts of one column as their places in sorted order; and these texts."""
    found: dict[str, int] = {}

    def number(text: str) -> int:
        if not (own := text.strip()):
            raise ValueError("an empty id")
        return found.setdefault(own, len(found))

    table = _csv(stream, comments=None, quotechar='"', converters={column: number})
    texts, place = np.unique(list(found), return_inverse=True)
    table[:, column] = place[table[:, column].astype(np.int64)]
    return table, texts.tolist()


def _csv(stream: BinaryIO, comments: str | None = "#", **how: Any) -> Array:
    """The numbers of the lines that are left; `how` as of `numpy.loadtxt`."""
    here = stream.tell()
    if b"\0" in stream.read(
        _LONGEST_HEAD
    ):  # a sparse or a binary file would take gigabytes to parse
        raise ValueError("not text")
    stream.seek(here)
    text = io.TextIOWrapper(stream, encoding="utf-8-sig")
    try:
        table: Array = np.loadtxt(text, delimiter=",", ndmin=2, comments=comments, **how)
    except UserWarning:  # of no data, naming the stream
        raise ValueError("no numbers in it") from None
    except ValueError as error:
        said = str(error).rstrip(".")
        raise ValueError(f"{said}; expected numbers with commas between them") from None
    finally:
        text.detach()  # else it would close the stream
    return table


_READERS: dict[str, Callable[[BinaryIO], Any]] = {".npy": load_npy, ".npz": load_npz, ".csv": _csv}
