"""Tables as kernels: read from files, and refused where they are none."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from tests.helpers import configured
from tests.motion.kernels import paper
from trackmdp import untrusted
from trackmdp.errors import UserError
from trackmdp.motion.kernels import load_table
from trackmdp.world.configured import build_world
from trackmdp.world.model import World


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".csv"])
def test_a_table_comes_back_from_a_file(tmp_path: Path, suffix: str) -> None:
    table, file = paper(3), tmp_path / f"kernel{suffix}"
    if suffix == ".npy":
        np.save(file, table)
    elif suffix == ".npz":
        np.savez(file, anything=table)
    else:
        np.savetxt(file, table, delimiter=",", fmt="%.18e")
    assert np.array_equal(load_table(3, path=file).toarray(), table)
    cfg = configured("train", "grid.size=3", "kernel=table", f"kernel.path={file}")
    assert np.array_equal(build_world(cfg).kernel.toarray(), table)


def test_of_many_arrays_the_one_called_kernel_is_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "many.npz", other=np.ones(3), kernel=paper(3))
    assert np.array_equal(load_table(3, path=tmp_path / "many.npz").toarray(), paper(3))


def _trap(file: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (file.with_name("executed").write_text, ("x",))

    array = np.empty(1, dtype=object)
    array[0] = Trap()
    np.save(file, array, allow_pickle=True)
    file.with_name("executed").unlink(missing_ok=True)


def _npz(file: Path, **arrays: np.ndarray) -> None:
    with file.open("wb") as stream:
        np.savez(stream, **arrays)


def _cut(file: Path) -> None:
    _npz(file, kernel=np.eye(9))
    file.write_bytes(file.read_bytes()[:200])


def _broken_member(file: Path) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("kernel.npy", b"no array")


UNREADABLE: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "missing": ("k.npy", lambda file: None, "no such file"),
    "folder": ("k.npy", lambda file: file.mkdir(), "is a directory"),
    "pipe": ("k.npy", os.mkfifo, "a pipe or a device, expected an ordinary file"),
    "claims": (
        "k.npy",
        lambda file: _claim(file, "(1000000000000,)"),
        "not a table of numbers",
    ),
    "sparse": ("k.csv", lambda file: _sparse(file, 2**29), "not text"),
    "too long": ("k.csv", lambda file: _sparse(file, 2**31), "expected at most"),
    "suffix": ("k.txt", lambda file: file.write_text("1"), "expected a .npy, .npz or .csv file"),
    "garbage": ("k.npy", lambda file: file.write_bytes(b"garbage"), "not a table of numbers"),
    "empty": ("k.npy", lambda file: file.touch(), "not a table of numbers"),
    "pickle": ("k.npy", lambda file: file.write_bytes(pickle.dumps([1])), "not a table of numbers"),
    "objects": ("k.npy", _trap, "not a table of numbers"),
    "texts": ("k.npy", lambda file: np.save(file, np.array([["a"]])), "not a table of numbers"),
    "complex": ("k.npy", lambda file: np.save(file, np.full((9, 9), 1j)), "not a table of numbers"),
    "no array": ("k.npz", _npz, "expected one array or one called 'kernel'"),
    "two arrays": (
        "k.npz",
        lambda file: _npz(file, a=np.eye(9), b=np.eye(9)),
        "expected one array or one called",
    ),
    "no zip": ("k.npz", lambda file: file.write_bytes(b"garbage"), "not a table of numbers"),
    "cut zip": ("k.npz", _cut, "not a table of numbers"),
    "broken member": ("k.npz", _broken_member, "not a table of numbers"),
    "one array, not a zip": ("k.npz", lambda file: _as_npy(file), "not a table of numbers"),
    "words": (
        "k.csv",
        lambda file: file.write_text("0.1,zero\n0.2,0.3\n"),
        "not a table of numbers",
    ),
    "ragged": ("k.csv", lambda file: file.write_text("0.1,0.2\n0.3\n"), "not a table of numbers"),
    "no rows": ("k.csv", lambda file: file.touch(), "not a table of numbers"),
    "bytes": ("k.csv", lambda file: file.write_bytes(b"\xff\xfe\x00"), "not a table of numbers"),
}


def _claim(file: Path, shape: str) -> None:
    head = (
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117)
        + b"\n"
    )
    file.write_bytes(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(64))


def _sparse(file: Path, size: int) -> None:
    with file.open("wb") as stream:
        stream.truncate(size)


def _as_npy(file: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.eye(9))
    file.write_bytes(buffer.getvalue())


@pytest.mark.parametrize("case", UNREADABLE)
def test_a_file_that_holds_no_table_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    name, write, rule = UNREADABLE[case]
    write(tmp_path / name)
    with pytest.raises(UserError) as refused:
        load_table(3, path=tmp_path / name)
    message = str(refused.value)
    assert "\n" not in message
    assert message.startswith(f"kernel.path={tmp_path / name}: ")
    assert rule in message
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("limit", [{"LARGE": 600}, {"free_bytes": lambda: 1200}])
@pytest.mark.parametrize(("kind", "size"), [(float, 776), (bool, 648)])  # 81 floats; their header
def test_an_archive_that_unfolds_to_more_than_memory_holds_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: dict[str, Any], kind: type, size: int
) -> None:
    np.savez_compressed(tmp_path / "k.npz", kernel=np.eye(9, dtype=kind))
    for name, value in limit.items():
        monkeypatch.setattr(untrusted, name, value)
    with pytest.raises(UserError, match=f"{size} bytes when unpacked, expected at most 600"):
        load_table(3, path=tmp_path / "k.npz")


def test_a_table_of_almost_nothing_but_zeros_is_read_however_small_it_is_packed(
    tmp_path: Path,
) -> None:
    table = np.zeros((3600, 3600))  # of a 60 x 60 grid: 99 MiB, packed some 800 to 1
    np.fill_diagonal(table, 0.9)
    np.savez_compressed(tmp_path / "k.npz", kernel=table)
    assert load_table(60, path=tmp_path / "k.npz").nnz == 3600


def _changed(row: int, column: int, value: float) -> np.ndarray:
    table = paper(3).copy()
    table[row, column] = value
    return table


BROKEN: dict[str, tuple[np.ndarray, str]] = {
    "a vector": (np.ones(9), r"expected a square table, got shape \(9,\)"),
    "not square": (np.ones((9, 8)), r"expected a square table, got shape \(9, 8\)"),
    "another grid": (np.eye(4) / 2, "4 rows, but a 3x3 grid has 9 cells"),
    "nan": (_changed(7, 2, np.nan), "row 7 holds a value that is not finite"),
    "inf": (_changed(6, 2, np.inf), "row 6 holds a value that is not finite"),
    "negative": (_changed(5, 8, -1e-9), "row 5 holds a negative probability"),
    "too much": (_changed(2, 2, 1.5), "row 2 sums to .*, expected at most 1"),
    "too large to be added up": (np.full((9, 9), 1e308), "row 0 sums to inf, expected at most 1"),
    "absorbing": (paper(3, exit_probability=0.0), "from cell 0 the target never exits"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_table_that_is_no_kernel_is_refused_with_row_and_rule(case: str) -> None:
    table, rule = BROKEN[case]
    with pytest.raises(UserError, match=rule) as refused:
        World(table, 3, cost=0.1, t_max=1)
    assert str(refused.value).startswith("kernel: ")
    assert "\n" not in str(refused.value)


def test_a_table_that_traps_the_target_needs_a_time_limit() -> None:
    """Cells 0 ... 2 lead to the exit, the pair (7, 8) never does; 3 may go either way."""
    table = np.zeros((9, 9))
    table[0, 1] = table[1, 2] = 1.0
    table[2, 0] = table[3, 7] = table[3, 0] = 0.5
    table[7, 8] = table[8, 7] = 1.0
    for cell in (4, 5, 6):
        table[cell, 0] = 1.0
    with pytest.raises(UserError, match=r"from cell 7 .* way out .*only whole episodes are solved"):
        World(table, 3, cost=0.1, t_max=1)
    assert np.array_equal(World(table, 3, cost=0.1, t_max=1, max_steps=9).kernel.toarray(), table)


def test_rounding_of_a_row_sum_is_forgiven() -> None:
    table = np.full((9, 9), 1 / 9)
    table[0] *= 0.5
    table[4] += 1e-11
    assert np.array_equal(World(table, 3, cost=0.1, t_max=1).kernel.toarray(), table)


@pytest.mark.parametrize("place", ["indices", "indptr"])
def test_a_sparse_kernel_whose_indices_lead_out_of_it_is_refused(place: str) -> None:
    matrix = sparse.csr_array(np.eye(9) * 0.9)
    getattr(matrix, place)[3] = 99
    with pytest.raises(UserError, match="kernel: not a sparse matrix") as refused:
        World(matrix, 3, cost=0.1, t_max=1)
    assert "\n" not in str(refused.value)
