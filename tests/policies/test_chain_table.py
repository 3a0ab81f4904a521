from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from trackmdp.policies.chain_table import CellClockNet, Neighbourhood

CPU = torch.device("cpu")


@given(st.integers(3, 8), st.integers(0, 9))
def test_the_output_for_a_cell_stands_for_it(size: int, radius: int) -> None:
    view, m = Neighbourhood(size, radius, CPU), size**2
    assert view.width == min((2 * radius + 1) ** 2, m)
    for start in range(m):
        distance = [max(abs(cell // size - start // size), abs(cell % size - start % size)) for cell in range(m)]
        near = [cell for cell in range(m) if distance[cell] <= radius]
        output = view.index(torch.full((len(near),), start), torch.tensor(near))
        assert view.cells[start, output].tolist() == near
        outside = view.index(torch.tensor([start]), torch.tensor([m]))
        assert 0 <= int(outside) < view.width


def test_an_output_stands_for_the_same_displacement_everywhere() -> None:
    view = Neighbourhood(6, 1, CPU)
    assert view.cells[7].tolist() == [0, 1, 2, 6, 7, 8, 12, 13, 14]
    assert view.cells[0].tolist() == [36, 36, 36, 36, 0, 1, 36, 6, 7]


def test_spread_puts_the_outputs_on_their_cells() -> None:
    view = Neighbourhood(6, 1, CPU)
    on = torch.zeros(36, 2, 9, dtype=torch.bool)
    on[7, 1, 8] = on[0, 0, 0] = True  # the second lies outside
    spread = view.spread(on)
    assert spread.shape == (36, 2, 36)
    assert spread.nonzero().tolist() == [[7, 1, 14]]


def test_rows_see_their_own_cell_and_clock_alone() -> None:
    net = CellClockNet(4, 3, hidden=8, outputs=5, bias=-1.0, generator=torch.Generator().manual_seed(0))
    before = net()
    assert before.shape == (4, 3, 5)
    with torch.no_grad():
        net.pair[2, 1] += 1.0
    changed = (net() != before).any(-1)
    assert changed.nonzero().tolist() == [[2, 1]]
