"""Motion kernels as tables: what holds for every kernel, and rows computed by hand."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import BORDERS, KERNELS, configured
from tests.motion.kernels import paper
from trackmdp.errors import UserError
from trackmdp.motion import kernels
from trackmdp.motion.kernels import drift, random_walk
from trackmdp.world.configured import build_world
from trackmdp.world.make import make_world


def window_of(size: int, cell: int, radius: int = 1) -> np.ndarray:
    """`[M]` whether each cell lies within `radius` rows and columns of `cell`."""
    row, column = np.divmod(np.arange(size**2), size)
    return (abs(row - cell // size) <= radius) & (abs(column - cell % size) <= radius)


@pytest.mark.parametrize("border", BORDERS)
@pytest.mark.parametrize("name", KERNELS)
def test_every_kernel_is_a_table_of_probabilities_within_reach(name: str, border: str) -> None:
    words = (
        "grid.size=6",
        f"kernel={name}",
        f"kernel.border={border}",
        "kernel.exit_probability=0.02",
    )
    table = build_world(configured("train", *words)).kernel.toarray()
    assert table.shape == (36, 36)
    assert table.dtype == np.float64
    assert (table >= 0).all()
    inner = [cell for cell in range(36) if 0 < cell // 6 < 5 and 0 < cell % 6 < 5]
    np.testing.assert_allclose(table.sum(axis=1)[inner], 0.98, rtol=1e-12)
    if border == "exit":
        assert (table.sum(axis=1) <= 0.98 + 1e-12).all()
        assert table.sum(axis=1).min() < 0.9
    else:
        np.testing.assert_allclose(table.sum(axis=1), 0.98, rtol=1e-12)
    for cell in range(36):
        assert not table[cell][~window_of(6, cell)].any()


@given(
    size=st.integers(3, 7),
    radius=st.integers(1, 2),
    share=st.floats(0, 1),
    low=st.floats(0.01, 0.6),
    exit_probability=st.sampled_from([0.0, 1e-6, 0.005, 0.3]),
    border=st.sampled_from(BORDERS),
    seed=st.integers(0, 2**32 - 1),
)
def test_random_support_keeps_its_promises(
    size: int,
    radius: int,
    share: float,
    low: float,
    exit_probability: float,
    border: Any,
    seed: int,
) -> None:
    count = 1 + round(share * ((2 * radius + 1) ** 2 - 1))
    table = paper(
        size,
        support_size=count,
        radius=radius,
        low_probability=low,
        exit_probability=exit_probability,
        border=border,
        seed=seed,
    )
    stay = 1.0 - exit_probability
    assert (table >= 0).all()
    for cell, row in enumerate(table):
        reach = window_of(size, cell, radius)
        assert not row[~reach].any()
        assert np.count_nonzero(row) <= count
        assert row.sum() <= stay + 1e-12
        if border != "exit":
            assert row.sum() == pytest.approx(stay, abs=1e-12)
        whole = reach.sum() == (2 * radius + 1) ** 2
        drawn = count if whole or border != "inside" else min(count, int(reach.sum()))
        if whole or border == "inside":
            expected = [low] + [(stay - low) / (drawn - 1)] * (drawn - 1) if drawn > 1 else [stay]
            np.testing.assert_allclose(np.sort(row[row > 0]), np.sort(expected), rtol=1e-12)


def test_the_kernel_seed_alone_decides_the_random_support() -> None:
    np.random.seed(1)  # noqa: NPY002  the generator that must not be used
    first = paper(seed=3)
    np.random.seed(2)  # noqa: NPY002
    assert np.array_equal(first, paper(seed=3))
    assert not np.array_equal(first, paper(seed=4))
    world = build_world(configured("train", "grid.size=5", "kernel.seed=3", "seed=17"))
    assert np.array_equal(world.kernel.toarray(), first)


def test_the_low_probability_falls_on_any_of_the_positions() -> None:
    """Over 200 inner cells of one draw each, the nine positions are all low some time and none far too often."""
    table = paper(17, support_size=9)
    inner = [row * 17 + column for row in range(1, 16) for column in range(1, 16)]
    offsets = [np.flatnonzero(np.isclose(table[cell], 0.15)) - cell for cell in inner]
    counts = np.unique(np.concatenate(offsets), return_counts=True)[1]
    assert counts.sum() == 225
    assert len(counts) == 9
    assert ((counts - 25) ** 2 / 25).sum() < 26.1  # chi-square, 8 degrees, 0.1 %


@pytest.mark.parametrize("border", BORDERS)
def test_a_corner_row_of_the_papers_kernel(border: Any) -> None:
    """All nine positions from cell 0: four lie in the grid, and clip folds the others onto three of them."""
    rest = (1 - 0.15 - 0.005) / 8
    folded = {0: 4, 1: 2, 5: 2, 6: 1}
    seen = set()
    for seed in range(20):
        row = paper(support_size=9, border=border, seed=seed)[0]
        assert set(np.flatnonzero(row)) == set(folded)
        inner_rest = (1 - 0.15 - 0.005) / 3
        within = {
            "renormalize": [
                {c: 0.995 * (0.15 if c == j else rest) / (0.15 + 3 * rest) for c in folded}
                for j in folded
            ]
            + [dict.fromkeys(folded, 0.995 / 4)],
            "exit": [{c: 0.15 if c == j else rest for c in folded} for j in folded]
            + [dict.fromkeys(folded, rest)],
            "inside": [{c: 0.15 if c == j else inner_rest for c in folded} for j in folded],
            "clip": [
                {c: folded[c] * rest + (0.15 - rest) * (c == j) for c in folded} for j in folded
            ],
        }[border]
        matching = [
            k
            for k, cells in enumerate(within)
            if np.allclose(row[list(cells)], list(cells.values()))
        ]
        assert len(matching) == 1, row[list(folded)]
        seen.add(matching[0])
    assert len(seen) > 2


def test_renormalize_stays_where_no_position_is_left() -> None:
    rows = [paper(support_size=1, border="renormalize", seed=seed)[0] for seed in range(30)]
    outside = [paper(support_size=1, border="exit", seed=seed)[0].sum() == 0 for seed in range(30)]
    assert 10 < sum(outside) < 25
    for row, left in zip(rows, outside, strict=True):
        assert row.max() == pytest.approx(0.995)
        if left:
            assert row[0] == pytest.approx(0.995)


@pytest.mark.parametrize(
    ("border", "row"),
    [
        ("renormalize", {0: 0.3, 1: 0.3, 3: 0.3}),
        ("inside", {0: 0.3, 1: 0.3, 3: 0.3}),
        ("clip", {0: 0.54, 1: 0.18, 3: 0.18}),
        ("exit", {0: 0.18, 1: 0.18, 3: 0.18}),
    ],
)
def test_a_corner_row_of_the_random_walk(border: Any, row: dict[int, float]) -> None:
    """Stay 0.2, each of four neighbours 0.2, exit 0.1; from cell 0 two neighbours lie outside."""
    table = random_walk(3, stay=0.2, diagonal=False, exit_probability=0.1, border=border).toarray()
    expected = np.zeros(9)
    expected[list(row)] = list(row.values())
    np.testing.assert_allclose(table[0], expected, atol=1e-15)
    np.testing.assert_allclose(table[4], [0, 0.18, 0, 0.18, 0.18, 0.18, 0, 0.18, 0], atol=1e-15)


def test_the_diagonal_random_walk_shares_among_eight() -> None:
    table = random_walk(3, stay=0.2, diagonal=True, exit_probability=0.1, border="exit").toarray()
    np.testing.assert_allclose(table[4], [0.09] * 4 + [0.18] + [0.09] * 4)
    np.testing.assert_allclose(table[8], [0, 0, 0, 0, 0.09, 0.09, 0, 0.09, 0.18], atol=1e-15)


@pytest.mark.parametrize(
    ("border", "row"),
    [
        ("clip", {1: 2 / 30, 2: 4 / 30 + 0.7, 4: 1 / 30, 5: 2 / 30}),
        ("exit", {1: 1 / 30, 2: 1 / 30, 4: 1 / 30, 5: 1 / 30}),
        ("renormalize", {1: 0.25, 2: 0.25, 4: 0.25, 5: 0.25}),
        ("inside", {1: 0.25, 2: 0.25, 4: 0.25, 5: 0.25}),
    ],
)
def test_a_corner_row_of_the_drift(border: Any, row: dict[int, float]) -> None:
    """Heading right with 0.7 from the right end of row 0 (cell 2), each of nine cells 1/30, exit 0.1."""
    table = drift(3, direction=0, persistence=0.7, exit_probability=0.1, border=border).toarray()
    expected = np.zeros(9)
    expected[list(row)] = list(row.values())
    np.testing.assert_allclose(table[2], 0.9 * expected, atol=1e-15)


@given(st.floats(0, 359.99))
def test_the_drift_heads_where_it_is_told(direction: float) -> None:
    """The heading is shared between the two nearest of the eight neighbours, in proportion to the angle."""
    row = drift(
        5, direction=direction, persistence=1.0, exit_probability=0.0, border="clip"
    ).toarray()[12]
    cells = np.flatnonzero(row)
    assert len(cells) <= 2
    angles = np.degrees(np.arctan2(2 - cells // 5, cells % 5 - 2)) % 360
    away = (angles - direction + 180) % 360 - 180
    assert abs(away).max() <= 45.0 + 1e-9
    assert row[cells] @ away == pytest.approx(0, abs=1e-9)


def test_all_kernels_are_listed() -> None:
    functions = inspect.getmembers(kernels, inspect.isfunction)
    made = {
        name
        for name, found in functions
        if found.__module__ == kernels.__name__ and not name.startswith("_")
    }
    assert made - {"load_table"} == set(KERNELS)


def test_an_argument_of_another_name_is_refused_with_the_right_one() -> None:
    with pytest.raises(UserError, match="grid_size: unknown argument, did you mean size"):
        make_world(grid_size=5)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"p_d": 0.9}, "p_d: unknown argument, expected detection"),
        ({"p_s": 0.9}, "p_s: unknown argument, expected safe_detection"),
        (
            {"sensor": "miss"},
            "sensor: unknown argument, expected coverage, detection and safe_detection",
        ),
    ],
)
def test_a_sensor_as_of_the_command_line_is_refused_with_the_arguments_for_it(
    options: dict[str, Any], expected: str
) -> None:
    with pytest.raises(UserError, match=f"^{expected}$"):
        make_world(**options)
