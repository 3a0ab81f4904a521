from __future__ import annotations

import torch

from trackmdp.policies.cell_clock import CellClockNet


def test_rows_see_their_own_cell_and_clock_alone() -> None:
    net = CellClockNet(
        4, 3, hidden=8, outputs=5, bias=-1.0, generator=torch.Generator().manual_seed(0)
    )
    before = net()
    assert before.shape == (4, 3, 5)
    with torch.no_grad():
        net.pair[2, 1] += 1.0
    changed = (net() != before).any(-1)
    assert changed.nonzero().tolist() == [[2, 1]]


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


def test_without_hidden_units_every_output_has_a_number_of_its_own() -> None:
    generator = torch.Generator().manual_seed(0)
    table = CellClockNet(4, 2, hidden=0, outputs=3, bias=-1.0, generator=generator)
    assert table.table.shape == (4, 2, 3)
    assert (table() == -1.0).all()
    table(slice(1, 3)).sum().backward()
    assert table.table.grad is not None
    assert table.table.grad.sum((1, 2)).tolist() == [0, 6, 6, 0]
    grouped = CellClockNet(
        4, 2, hidden=0, outputs=3, bias=0.0, generator=generator, groups=torch.tensor([0, 1, 1, 0])
    )
    with torch.no_grad():
        grouped.table[1] += 1.0
    assert grouped().sum((1, 2)).tolist() == [0, 6, 6, 0]
    assert grouped(slice(2, 4)).sum((1, 2)).tolist() == [6, 0]
