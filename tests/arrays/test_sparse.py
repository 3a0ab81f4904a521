"""Sparse kernels: sums to the bit of the dense ones, rectangles, matrices from files, and what they take in memory."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from tests.helpers import BORDERS
from trackmdp.arrays.entries import distinct, row_sums
from trackmdp.errors import UserError
from trackmdp.motion.kernels import load_table, random_support, random_walk
from trackmdp.world.model import World

SIDES = st.integers(1, 6)


@given(
    st.sampled_from([1, 7, 8, 9, 100, 127, 128, 129, 137, 400, 1600]),
    st.floats(0, 1),
    st.integers(0, 2**32 - 1),
)
def test_row_sums_are_those_of_the_dense_matrix_to_the_bit(
    columns: int, density: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    dense = rng.random((20, columns)) * (rng.random((20, columns)) < density)
    assert np.array_equal(row_sums(sparse.csr_array(dense)), dense.sum(axis=1))


@given(SIDES, SIDES, st.sampled_from(BORDERS), st.booleans(), st.floats(0.01, 0.99))
def test_a_symmetric_walk_on_the_turned_grid_is_the_turned_walk(
    rows: int, columns: int, border: Any, diagonal: bool, stay: float
) -> None:
    """Cell (i, j) of [a, b] is cell (j, i) of [b, a]."""
    options: dict[str, Any] = {
        "stay": stay,
        "diagonal": diagonal,
        "exit_probability": 0.1,
        "border": border,
    }
    flat = random_walk((rows, columns), **options).toarray().reshape(rows, columns, rows, columns)
    turned = random_walk((columns, rows), **options).toarray().reshape(columns, rows, columns, rows)
    np.testing.assert_allclose(flat.transpose(1, 0, 3, 2), turned, rtol=1e-14, atol=1e-16)


@given(st.integers(0, 2**32 - 1))
def test_dense_and_sparse_tables_make_the_same_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    table = rng.random((12, 12)) * (rng.random((12, 12)) < 0.4) / 12
    dense, csr = (
        World(table, (3, 4), cost=0.1, t_max=1),
        World(sparse.coo_array(table), (3, 4), cost=0.1, t_max=1),
    )
    for name in ("data", "indices", "indptr"):
        assert np.array_equal(getattr(dense.kernel, name), getattr(csr.kernel, name))
    assert dense.kernel.has_canonical_format
    assert np.array_equal(dense.stay_probability, table.sum(axis=1))


def test_a_sparse_matrix_comes_back_from_a_file(tmp_path: Path) -> None:
    kernel = random_walk((3, 4), stay=0.3, diagonal=True, exit_probability=0.1, border="exit")
    sparse.save_npz(tmp_path / "k.npz", sparse.csr_matrix(kernel))
    assert (load_table((3, 4), path=tmp_path / "k.npz") != kernel).nnz == 0


@pytest.mark.parametrize(
    "changed",
    [
        {"indices": np.array([0, 9])},
        {"indptr": np.array([0, 2, 1])},
        {"indptr": np.array([0, 2])},
        {"data": np.array([1 + 1j, 0])},
        {"data": np.array(["x", "y"])},
        {"indices": np.array([0.0, 1.0])},
        {"format": np.array(b"csc")},
    ],
)
def test_arrays_that_are_no_matrix_are_refused(
    tmp_path: Path,
    changed: dict[str, np.ndarray],
) -> None:
    arrays = {
        "data": np.ones(2),
        "indices": np.array([0, 1]),
        "indptr": np.array([0, 1, 2]),
        "shape": np.array([2, 2]),
    }
    np.savez(tmp_path / "k.npz", **(arrays | changed))
    with pytest.raises(UserError) as refused:
        load_table((1, 2), path=tmp_path / "k.npz")
    assert str(refused.value).startswith(f"kernel.path={tmp_path / 'k.npz'}: ")


def test_memory_follows_the_support() -> None:
    """256 x 256 cells with five moves each; a dense table would take 34 GB."""
    tracemalloc.start()
    kernel = random_support(
        256,
        support_size=5,
        radius=1,
        low_probability=0.15,
        exit_probability=0.005,
        border="renormalize",
        seed=0,
    )
    world = World(kernel, 256, cost=0.16, t_max=1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6
    assert world.kernel.nnz <= 5 * 256**2


@pytest.mark.parametrize(("given", "once"), [([5, -1, 5, 0], [-1, 0, 5]), ([], []), ([7], [7])])
def test_numbers_in_order_each_once(given: list[int], once: list[int]) -> None:
    assert distinct(np.array(given, dtype=np.int32)).tolist() == once
