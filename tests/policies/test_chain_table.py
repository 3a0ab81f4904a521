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


def test_cells_of_a_group_see_the_same_border() -> None:
    """6 x 6 cells, radius 1: four corners, four edges, one inside."""
    groups = Neighbourhood(6, 1, CPU).groups().view(6, 6)
    assert int(groups.max()) == 8
    inside = groups[1:5, 1:5]
    assert (inside == inside[0, 0]).all()
    assert len(set(groups.flatten().tolist())) == 9
    for edge in (groups[0, 1:5], groups[5, 1:5], groups[1:5, 0], groups[1:5, 5]):
        assert (edge == edge[0]).all()
        assert edge[0] != inside[0, 0]


@given(st.integers(3, 9), st.integers(0, 4))
def test_a_group_has_the_same_window(size: int, radius: int) -> None:
    view = Neighbourhood(size, radius, CPU)
    if not view.moves_along:
        return
    groups, inside = view.groups(), view.cells < size**2
    for group in groups.unique():
        windows = inside[groups == group]
        assert (windows == windows[0]).all()


def test_cells_of_a_group_share_all_weights() -> None:
    generator = torch.Generator().manual_seed(0)
    groups = torch.tensor([0, 1, 1, 0])
    net = CellClockNet(4, 2, hidden=8, outputs=3, bias=0.0, generator=generator, groups=groups)
    rows = net()
    assert rows.shape == (4, 2, 3)
    assert (rows[0] == rows[3]).all()
    assert (rows[1] == rows[2]).all()
    assert not (rows[0] == rows[1]).any()
    rows[0].sum().backward()
    assert net.cell.grad is not None
    assert net.cell.grad[0].any()
    assert not net.cell.grad[1].any()
