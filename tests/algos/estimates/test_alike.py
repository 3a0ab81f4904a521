"""Moves pooled over cells from which the target moves alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import sparse

from tests.helpers import later
from trackmdp.algos.estimates.alike import AlikeCells, cell_classes
from trackmdp.algos.estimates.kernel_estimate import KernelEstimate
from trackmdp.app.cli import main
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.sensing.windows import Window
from trackmdp.world.make import make_world


def counts_of(kernel: Array, moves: int, seed: int = 0) -> sparse.csr_array:
    """`[M, M + 1]`, `moves` drawn out of each cell."""
    rng = np.random.default_rng(seed)
    rows = np.c_[kernel, 1.0 - kernel.sum(axis=1)]
    return sparse.csr_array(np.stack([rng.multinomial(moves, row) for row in rows]).astype(float))


def test_cells_as_far_from_the_borders_share_their_moves() -> None:
    """3 rows of 6 cells, moves of one: 8 and 9 are inner cells, as are 7 and 10; 13 lies at the lower border."""
    counts = sparse.csr_array((18, 19))
    seen = sparse.lil_array(counts)
    seen[8, 9], seen[8, 18], seen[9, 15], seen[13, 14] = 3, 1, 2, 5
    pooled = AlikeCells((3, 6), 1).pooled(sparse.csr_array(seen)).toarray()
    for cell in (7, 8, 9, 10):
        expected = np.zeros(19)
        expected[[cell + 1, cell + 6, 18]] = 3, 2, 1
        np.testing.assert_array_equal(pooled[cell], expected)
    assert pooled[14, 15] == 5
    assert pooled.sum() == 4 * 6 + 4 * 5


@pytest.mark.parametrize(
    ("kind", "alike"), [("drift", True), ("random_walk", True), ("random_support", False)]
)
@pytest.mark.parametrize("moves", [30, 3000])
def test_the_moves_seen_say_which_cells_are_alike(kind: str, moves: int, *, alike: bool) -> None:
    kernel = make_world(kind, size=10).kernel.toarray()
    found = AlikeCells((10, 10), 1, counts_of(kernel, moves))
    assert len(found.first) == (9 if alike else 100)


def test_shares_of_moves_too_small_to_be_inverted_tell_nothing() -> None:
    counts = counts_of(make_world("drift", size=10).kernel.toarray(), 3000)
    counts.data[counts.indptr[44] : counts.indptr[45]] *= 1e-312
    assert len(AlikeCells((10, 10), 1, counts).first) == 9


@pytest.mark.parametrize(("kind", "alike"), [("drift", True), ("random_support", False)])
def test_traces_of_moves_that_were_inferred_tell_nothing(kind: str, *, alike: bool) -> None:
    """Each cell has 1e-6 of a move to cells that it never goes to, as rounds of expectation-maximisation leave them."""
    kernel = make_world(kind, size=10).kernel.toarray()
    cell = np.arange(100)
    near = (
        np.abs(np.subtract.outer(cell // 10, cell // 10)).clip(
            np.abs(np.subtract.outer(cell % 10, cell % 10))
        )
        <= 2
    )
    inferred = sparse.csr_array(counts_of(kernel, 300) + 1e-6 * np.c_[near, np.ones(100)])
    assert len(AlikeCells((10, 10), 2, inferred).first) == (25 if alike else 100)


def test_pooled_estimates_are_nearer_to_the_motion() -> None:
    kernel = make_world("drift", size=10).kernel.toarray()
    estimates = [
        KernelEstimate(10, weight=0.1, exit_weight=1.0, share_cells=shared)
        for shared in (False, True, None)
    ]
    errors = []
    for estimate in estimates:
        estimate.direct = estimate.counts = counts_of(kernel, 300)
        errors.append(np.abs(estimate.mean()[:, :-1].toarray() - kernel)[33])
    assert errors[1].max() < 0.4 * errors[0].max()
    np.testing.assert_array_equal(errors[1], errors[2])


def test_alike_cells_are_drawn_once() -> None:
    estimate = KernelEstimate(10, weight=0.1, exit_weight=1.0, share_cells=True)
    estimate.direct = estimate.counts = counts_of(
        make_world("random_walk", size=10).kernel.toarray(), 30
    )
    first, second = (
        next(estimate.samples(np.random.default_rng(seed), 1)).toarray() for seed in (0, 1)
    )
    np.testing.assert_array_equal(first[44, [43, 45, 34, 54]], first[55, [54, 56, 45, 65]])
    assert first[44, 45] != second[44, 45]
    np.testing.assert_allclose(first.sum(axis=1), 1.0)


def test_a_drawn_kernel_has_a_way_out_though_no_exit_was_seen() -> None:
    """The exit's posterior after 50 moves from each cell is Beta(0.01, 150): most draws are 0 but for rounding."""
    estimate = KernelEstimate(3, weight=0.1, exit_weight=100.0)
    moves = np.tile(np.arange(9), 50)
    estimate.add_moves(moves, np.roll(np.arange(9), 1)[moves])
    for seed in range(5):
        assert next(estimate.samples(np.random.default_rng(seed), 1)).toarray()[:, 9].min() >= 1e-9


def test_what_share_cells_says(tmp_path: Path) -> None:
    assert cell_classes(None, (2, 3)) is None
    assert cell_classes("none", (2, 3)) is None
    assert (cell_classes("all", (2, 3)) == np.zeros(6)).all()
    file, table = str(tmp_path / "map.npy"), np.array([[5, 5, 1], [5, 1, 1]])
    for given in (table, table.ravel(), table.astype(np.uint8)):
        np.save(file, given)
        assert (cell_classes(file, (2, 3)) == table.ravel()).all()
    for given, shape in (
        (table.T, "3 x 2"),
        (table.ravel()[:5], "5"),
        (table + 0.5, "2 x 3"),
        (table * np.inf, "2 x 3"),
        (table * 1e300, "2 x 3"),
    ):
        np.save(file, given)
        with pytest.raises(
            UserError, match=rf"expected 6 or 2 x 3 whole numbers, .*, got float64 {shape}$"
        ):
            cell_classes(file, (2, 3))


def test_cells_of_different_classes_share_nothing() -> None:
    """The upper half goes right, the lower half left: pooled by class the estimate is the motion, pooled at all not."""
    right, left = np.diag(np.full(99, 0.9), 1), np.diag(np.full(99, 0.9), -1)
    kernel = np.vstack([right[:50], left[50:]])
    kernel[9::10, :] = kernel[::10, :] = 0  # who comes to the left or right border exits
    classes = np.repeat([7, 3], 50)
    errors = []
    for given in (classes, None):
        estimate = KernelEstimate(10, weight=0.1, exit_weight=1.0, share_cells=True, classes=given)
        estimate.direct = estimate.counts = counts_of(kernel, 30)
        errors.append(np.abs(estimate.mean()[:, :-1].toarray() - kernel)[33].max())
    assert errors[0] < 0.03
    assert errors[1] > 0.3


def test_decisions_are_shared_where_all_classes_around_are_the_same() -> None:
    """On a line of 9 cells, classes 0 0 0 0 0 1 1 1 1 and a window of 1: 1, 2, 3 are alike, and so are 6 and 7."""
    groups = Window((1, 9), 1).groups(torch.tensor([0, 0, 0, 0, 0, 1, 1, 1, 1])).tolist()
    assert [groups.count(groups[cell]) for cell in range(9)] == [1, 3, 3, 3, 1, 1, 2, 2, 1]
    assert groups[1] == groups[2] == groups[3] != groups[6] == groups[7]
    window = Window((5, 6), 1)
    assert (window.groups(torch.full((30,), 4)) == window.groups()).all()


def test_a_csv_file_with_a_class_in_each_line_is_read(tmp_path: Path) -> None:
    file = tmp_path / "classes.csv"
    np.savetxt(file, np.arange(6) % 3, fmt="%d")
    assert cell_classes(str(file), (2, 3)).tolist() == [0, 1, 2, 0, 1, 2]  # type: ignore[union-attr]


@pytest.mark.parametrize("algo", ["hindsight", *later(["model_based"])])
def test_other_words_and_wrong_maps_are_refused(
    algo: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "map.npy", np.zeros((3, 4)))
    words = ["train", f"algo={algo}", "grid.size=4", f"hydra.run.dir={tmp_path / 'run'}"]
    for given, named in (
        ("true", ["all", "none", ".npy"]),
        ("false", ["all", "none", ".npy"]),
        (tmp_path / "map.npy", [f"{tmp_path / 'map.npy'}", "16", "4 x 4", "float64", "3 x 4"]),
        (tmp_path / "none.npy", [f"{tmp_path / 'none.npy'}"]),
    ):
        assert main([*words, f"algo.share_cells={given}"]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "algo.share_cells" in error
        assert all(name in error for name in named)
    assert not (tmp_path / "run").exists()
