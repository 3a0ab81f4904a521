"""What both buffers of sensed paths draw with; which steps count is told by the tests of each."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from trackmdp.algos.moves import CellIndex, cell_dtype, stratified_starts


def test_the_places_of_a_cell_are_cut_evenly() -> None:
    """Sorted, the entries start in 0, 2, 2, 2: one place for 0, three for 2, and the one after them for 1 and 3."""
    index = CellIndex.of(torch.tensor([2, 0, 2, 2]), 3)
    assert index.first.tolist() == [0, 4, 1, 4]
    draws = torch.tensor([0.0, 0.99, 0.0, 0.33, 0.34, 0.66, 0.67, 0.99, 0.5, 0.5])
    cells = torch.tensor([0, 0, 2, 2, 2, 2, 2, 2, 1, 3])
    assert index.pick(cells, draws).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


@given(st.integers(1, 20_000))
def test_a_draw_that_was_rounded_up_to_one_stays_with_its_cell(entries: int) -> None:
    index = CellIndex.of(torch.zeros(entries, dtype=torch.int64), 2)
    assert index.pick(torch.tensor([0]), torch.ones(1)).item() == entries - 1


@given(st.integers(1, 200), st.integers(1, 3), st.integers(1, 30), st.integers(0, 2**31))
def test_starts_are_even_and_first_draws_stratified(
    count: int, steps: int, cells: int, seed: int
) -> None:
    start, draws = stratified_starts(count, steps, cells, torch.Generator().manual_seed(seed))
    assert draws.shape == (steps, count)
    often = torch.bincount(start, minlength=cells)
    assert often.max() - often.min() <= 1
    for cell in start.unique():
        first = draws[0, start == cell]
        within = first * len(first) - torch.arange(len(first))
        assert -1e-4 < within.min() <= within.max() < 1 + 1e-4


def test_cells_of_large_grids_fit() -> None:
    """M itself stands for the exit: 181 x 181 cells take 16 bits, 182 x 182 take more."""
    for side, dtype in ((181, torch.int16), (182, torch.int32)):
        assert cell_dtype(side**2) is dtype
        assert torch.tensor(side**2, dtype=dtype).item() == side**2
