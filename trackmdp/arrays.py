"""Arrays in `.npy` and `.npz` files that somebody else may have written: never unpickled, never larger than they claim.

`numpy.load` believes a header: an `.npy` of 200 bytes that claims 10^12 numbers makes it ask for 8 TB, and an `.npz` of
2 MB may unfold to gigabytes. Here what is claimed is held against what is there before anything is allocated.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

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
