"""Tables of numbers in files that somebody else may have written: never unpickled, never larger than they claim.

`numpy.load` believes a header: an `.npy` of 200 bytes that claims 10^12 numbers makes it ask for 8 TB, and an `.npz` of
2 MB may unfold to gigabytes. Here what is claimed is held against what is there before anything is allocated.
"""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.errors import UserError
from trackmdp.untrusted import decoded, opened
from trackmdp.world.checks import Range, one_each
from trackmdp.world.model import Array, Size, grid_size

LARGE = 2**32
"""Bytes of the largest table that is read: 4 GiB, once unfolded."""

_MEMBERS = 256
_HEADER = 10_000
_FREE, _RATIO = 2**26, 300
"""An archive may unfold to 64 MiB however small it is, and beyond that to 300 times its size. Deflate reaches 1,030 on
zeros alone; the kernel of a 40 x 40 grid, nine entries to a row of 1,600, reaches 150."""

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def size_of(stream: BinaryIO) -> int:
    """Bytes from where the stream stands to its end; it stays where it is."""
    here = stream.tell()
    end = stream.seek(0, os.SEEK_END)
    stream.seek(here)
    return end - here


def load_npy(stream: Any, size: int) -> npt.NDArray[Any]:
    """The array of the next `size` bytes of `stream`, which are an `.npy` file.

    Raises:
        ValueError: they are something else, hold Python objects or complex numbers, or are more or fewer than their
            header claims.
        Exception: whatever NumPy raises over a header; call it inside `untrusted.decoded`.
    """
    content = stream.read(size + 1)  # to the very end, where zipfile compares the checksum
    head = io.BytesIO(content)
    # An .npy file: 6 bytes magic (\x93NUMPY), 2 of version, 2 (version 1.0) or 4 (2.0) with the header's length, the
    # header as the text of a Python dict such as {'descr': '<f8', 'fortran_order': False, 'shape': (3, 4)}, then the
    # numbers. Version 3.0 differs in allowing any UTF-8 in field names, which arrays without fields do not have.
    version = np.lib.format.read_magic(head)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError("an .npy file of another version than 1.0 and 2.0")
    shape, fortran, dtype = readers[version](head, max_header_size=_HEADER)
    # Objects would be unpickled, which runs code; no file of ours is structured or raw (V), or complex (c).
    if dtype.hasobject or dtype.kind in "Vc":
        raise ValueError(f"an array of {dtype}")
    if any(length < 0 for length in shape):
        raise ValueError(f"a shape of {shape}")
    # Python's integers do not overflow: a shape of (2**40, 2**40) cannot wrap around to a small product.
    claimed, left = math.prod(shape) * dtype.itemsize, len(content) - head.tell()
    if claimed != left:
        raise ValueError(f"its header claims {claimed:,} bytes of numbers, there are {left:,}")
    # `bytearray`: an array over `bytes` could not be written to.
    flat = np.frombuffer(bytearray(head.read()), dtype) if claimed else np.zeros(0, dtype)
    return flat.reshape(shape, order="F" if fortran else "C")


def load_npz(stream: BinaryIO) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an `.npz` file by their names.

    Raises:
        ValueError: it is damaged, oversized, encrypted or packed in an unusual way.
        Exception: whatever zipfile and NumPy raise over damage; call it inside `untrusted.decoded`.
    """
    packed = size_of(stream)
    with zipfile.ZipFile(stream) as archive:
        members = archive.infolist()
        if len(members) > _MEMBERS:
            raise ValueError(f"{len(members):,} arrays")
        # The sizes that the archive's directory claims; that each member keeps to its own is seen to while it is read.
        unfolded = sum(member.file_size for member in members)
        if unfolded > min(LARGE, max(_FREE, _RATIO * packed)):
            raise ValueError(f"{packed:,} bytes that unfold to {unfolded:,}")
        for member in members:
            # Bit 0 of the flags: encrypted. NumPy writes stored and deflated members only.
            if member.compress_type not in _METHODS or member.flag_bits & 1:
                raise ValueError(f"{member.filename!r} is encrypted, or neither stored nor deflated")
        found = {}
        for member in members:
            with archive.open(member) as content:
                found[member.filename.removesuffix(".npy")] = load_npy(content, member.file_size)
        return found


def npy_bytes(array: npt.NDArray[Any]) -> bytes:
    """The content of an `.npy` file."""
    stream = io.BytesIO()
    np.save(stream, np.ascontiguousarray(array), allow_pickle=False)
    return stream.getvalue()


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """The content of an `.npz` file; the same arrays, the same bytes."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


_LONGEST_TEXT, _LONGEST_HEAD = 2**30, 2**16
"""Bytes of the longest .csv file, a recording of some eighty million steps, and of its first line."""


_T = TypeVar("_T")

_CSR = {"data", "indices", "indptr", "shape"}


def read_numbers(key: str, path: str | Path, *, name: str) -> Array:
    """The numbers in a .npy, .npz (its only array, or the one called `name`) or .csv file; nothing is unpickled.

    Raises:
        UserError: there is no such file, or it does not hold real numbers; `key` is named as the option at fault.
    """
    table = read_matrix(key, path, name=name)
    if sparse.issparse(table):
        raise UserError(f"{key}={path}: a sparse matrix, expected a table of numbers")
    return table


def per_cell(
    key: str, given: float | list[float] | str, size: Size, allowed: Range, sensors: int | None = None
) -> Array:
    """`[M]` one number per cell, or `[S]` per sensor: one for all, a list, or what is in a file.

    Args:
        key: the option, for messages.
        given: a number, a list, or a path as in `read_numbers`.
        size: of the grid.
        allowed: which of some numbers are in range, and the range in words.
        sensors: S, where the numbers are those of sensors that lie at no cell.

    Raises:
        UserError: a list or file is missing or malformed, holds another number of numbers, or one out of range.
    """
    count, each = (math.prod(grid_size(size)), "cell") if sensors is None else (sensors, "sensor")
    if not isinstance(given, str):
        return one_each(key, given, count, each, allowed)
    values = read_numbers(key, given, name=key.rpartition(".")[2]).ravel()
    return one_each(f"{key}={given}", values, count, each, allowed)


def read_matrix(key: str, path: str | Path, *, name: str) -> sparse.csr_array | Array:
    """The table in a file of `read_numbers`, or the CSR matrix in an .npz as `scipy.sparse.save_npz` writes it.

    Raises:
        UserError: there is no such file, or it holds no real numbers, or no matrix.
    """
    source, file = f"{key}={path}", Path(path)
    with _opened(source, file) as stream:
        table = _read(source, file.suffix, stream, name)
    if table.dtype.kind not in "biuf":
        raise UserError(f"{source}: not a table of numbers (but of {table.dtype})")
    return table.astype(np.float64)


def csr_of(arrays: Mapping[str, np.ndarray]) -> sparse.csr_array:
    """The CSR matrix of float64 with the arrays `data`, `indices`, `indptr` and `shape`.

    Raises:
        ValueError: they do not fit together; SciPy would read outside its memory.
    """
    data, indices, indptr, shape = (np.asarray(arrays[name]) for name in ("data", "indices", "indptr", "shape"))
    if str(np.asarray(arrays.get("format", "csr")).astype(str)) != "csr":
        raise ValueError("a sparse matrix of another format than csr")
    if data.dtype.kind not in "biuf" or shape.dtype.kind not in "iu":
        raise ValueError("a sparse matrix of other things than numbers")
    rows, columns = (int(side) for side in shape)  # ValueError where there are not two
    return whole_csr(data.astype(np.float64), indices, indptr, (rows, columns))


def whole_csr(data: Any, indices: Any, indptr: Any, shape: tuple[int, int]) -> sparse.csr_array:
    """The CSR matrix of arrays from somebody else's file, whose indices may lead anywhere.

    Raises:
        ValueError: they do not fit together, or lead out of `shape`.
    """
    if any(np.asarray(each).dtype.kind not in "iu" for each in (indices, indptr)):  # SciPy would cut them to integers
        raise ValueError("a sparse matrix whose indices are other things than whole numbers")
    matrix = sparse.csr_array((data, indices, indptr), shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def csr_bytes(matrix: sparse.csr_array) -> bytes:
    """A CSR matrix in an .npz, as SciPy saves it."""
    stream = io.BytesIO()
    sparse.save_npz(stream, matrix)
    return stream.getvalue()


def csr_in(content: bytes) -> sparse.csr_array:
    """The CSR matrix in the content of an .npz; errors as of `load_npz` and `csr_of`."""
    return csr_of(load_npz(io.BytesIO(content)))


def read_columns(key: str, path: str | Path) -> dict[str, Array]:
    """The columns of a .csv file under the names in its first line, or the arrays of an .npz; nothing is unpickled.

    Raises:
        UserError: there is no such file, or it does not hold columns of real numbers, all of one length.
    """
    source, suffix = f"{key}={path}", Path(path).suffix
    if suffix not in (".csv", ".npz"):
        raise UserError(f"{source}: expected a .csv or .npz file")
    with _opened(source, Path(path)) as stream:
        columns = _csv_columns(stream) if suffix == ".csv" else load_npz(stream)
    for name, column in columns.items():
        if column.dtype.kind not in "iuf" or column.ndim != 1:
            raise UserError(f"{source}: {name} is not a column of numbers (but {column.dtype}, shape {column.shape})")
    if len({len(column) for column in columns.values()}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in columns.items())
        raise UserError(f"{source}: columns of different lengths ({lengths})")
    return {name: column.astype(np.float64) for name, column in columns.items()}


def once(read: Callable[..., _T], path: str | Path, *how: Hashable) -> _T:
    """`read(path, *how)`, kept until the file changes: a run is checked before its folder is made, and asks again."""
    file = Path(path)
    stamp = (file.stat().st_mtime_ns, file.stat().st_size, file.stat().st_ino) if file.is_file() else None
    return _kept(read, path, how, stamp)


@lru_cache(maxsize=1)
def _kept(read: Callable[..., Any], path: str | Path, how: tuple[Hashable, ...], stamp: Any) -> Any:  # noqa: ARG001
    """See `once`; `stamp` tells the file from what it was before."""
    return read(path, *how)


def column_names(key: str, path: str | Path) -> list[str]:
    """The names in the first line of a .csv file.

    Raises:
        UserError: there is no such file, or its first line is not text.
    """
    with _opened(f"{key}={path}", Path(path)) as stream:
        return first_line(stream)


@contextmanager
def _opened(source: str, file: Path) -> Iterator[BinaryIO]:
    """The file, open; what goes wrong with it ends in one line that begins with `source`."""
    most = _LONGEST_TEXT if file.suffix == ".csv" else LARGE
    with (
        # The user named this very file, so it may be a link: data sets on a cluster often are.
        opened(file, most=most, source=source, links=True) as stream,
        decoded(source, "a table of numbers"),
        warnings.catch_warnings(action="error"),  # numpy only warns of an empty .csv
    ):
        yield stream


def _csv_columns(stream: BinaryIO) -> dict[str, np.ndarray]:
    names = first_line(stream)
    if len(set(names)) < len(names):
        raise ValueError(f"two columns of one name in {','.join(names)[:80]}")
    if not stream.read(1):
        return {name: np.zeros(0) for name in names}
    stream.seek(-1, os.SEEK_CUR)
    table = _csv(stream, comments=None)
    if table.shape[1] != len(names):
        raise ValueError(f"{len(names)} names in the first line, but {table.shape[1]} columns")
    return dict(zip(names, table.T, strict=True))


def first_line(stream: BinaryIO) -> list[str]:
    """The names in the first line of a .csv file, which is read."""
    line = stream.readline(_LONGEST_HEAD)
    if len(line) == _LONGEST_HEAD:
        raise ValueError(f"a first line of more than {_LONGEST_HEAD:,} bytes")
    return [name.strip().strip('"') for name in line.decode("utf-8-sig").split(",")]


def _csv(stream: BinaryIO, comments: str | None = "#") -> Array:
    """The numbers of the lines that are left."""
    here = stream.tell()
    if b"\0" in stream.read(_LONGEST_HEAD):  # a sparse file, UTF-16, a binary one: not worth gigabytes of parsing
        raise ValueError("not text")
    stream.seek(here)
    text = io.TextIOWrapper(stream, encoding="utf-8-sig")
    table: Array = np.loadtxt(text, delimiter=",", ndmin=2, comments=comments)
    text.detach()  # else it closes the stream, which is its opener's
    return table


def _read(source: str, suffix: str, stream: BinaryIO, name: str) -> Any:
    if suffix == ".npy":
        return load_npy(stream, size_of(stream))
    if suffix == ".npz":
        arrays = load_npz(stream)
        if set(arrays) >= _CSR:
            return csr_of(arrays)
        if name not in arrays and len(arrays) != 1:
            raise UserError(f"{source}: expected one array or one called '{name}', found {list(arrays)[:9]}")
        return arrays[name if name in arrays else next(iter(arrays))]
    if suffix == ".csv":
        return _csv(stream)
    raise UserError(f"{source}: expected a .npy, .npz or .csv file")
