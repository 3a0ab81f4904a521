"""Windows against hand numbers, and their conversions against each other."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from trackmdp.sensing.task import Task
from trackmdp.sensing.windows import Window

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 6))
RADII = st.one_of(st.none(), st.integers(0, 7))


@given(SIZES, RADII, st.integers(0, 2**32 - 1))
def test_local_and_global_are_inverse_within_the_window(
    size: tuple[int, int], radius: int | None, seed: int
) -> None:
    window, rng = Window(size, radius), torch.Generator().manual_seed(seed)
    m = window.num_cells
    start = torch.randint(m, (3, 5), generator=rng)
    everywhere = torch.rand(3, 5, m, generator=rng) < 0.5
    reached = torch.stack(
        [window.contains(start, torch.full_like(start, cell)) for cell in range(m)], dim=-1
    )
    local = window.to_local(start, everywhere)
    assert local.shape == (3, 5, window.width)
    assert torch.equal(window.to_global(start, local), everywhere & reached)
    assert torch.equal(window.to_local(start, window.to_global(start, local)), local)


@given(SIZES, RADII)
def test_a_window_holds_the_cells_within_its_radius(
    size: tuple[int, int], radius: int | None
) -> None:
    window, (rows, columns) = Window(size, radius), size
    m = rows * columns
    for start in range(m):
        near = [
            cell
            for cell in range(m)
            if radius is None
            or max(abs(cell // columns - start // columns), abs(cell % columns - start % columns))
            <= radius
        ]
        assert [cell for cell in window.cells[start].tolist() if cell < m] == near
        cells, starts = torch.arange(m + 1), torch.full((m + 1,), start)
        assert window.contains(starts, cells).nonzero().squeeze(-1).tolist() == near
        place = window.index(starts, cells)
        assert ((place >= 0) & (place < window.width)).all()
        assert window.cells[start, place[near]].tolist() == near
        found = window.find(starts, cells)
        assert torch.equal(found[near], place[near])
        assert (found[[cell for cell in range(m + 1) if cell not in near]] >= window.width).all()
        assert torch.equal(window.inside(starts[:1]), (window.around(starts[:1]) < m))


def test_the_window_of_a_task_is_that_of_its_option() -> None:
    assert Window.of(Task((4, 7), cost=0.1, t_max=0, window=1)).width == 9
    whole = Window.of(Task((4, 7), cost=0.1, t_max=0))
    assert (whole.width, whole.is_local) == (28, False)
    assert (
        Window.of(Task(3, cost=0.1, t_max=0, window=2)).width == 25
    )  # corners lie outside, seen from anywhere


def test_on_a_rectangle_by_hand() -> None:
    window = Window((3, 4), 1)  # 0 1 2 3 / 4 5 6 7 / 8 9 10 11
    assert window.cells[6].tolist() == [1, 2, 3, 5, 6, 7, 9, 10, 11]
    assert window.cells[11].tolist() == [6, 7, 12, 10, 11, 12, 12, 12, 12]
    assert window.index(torch.tensor([6, 11]), torch.tensor([9, 6])).tolist() == [6, 0]


@given(st.integers(3, 8), st.integers(0, 9))
def test_the_local_number_of_a_cell_stands_for_it(size: int, radius: int) -> None:
    view, m = Window.reaching(size, radius), size**2
    assert view.width == min((2 * radius + 1) ** 2, m)
    for start in range(m):
        distance = [
            max(abs(cell // size - start // size), abs(cell % size - start % size))
            for cell in range(m)
        ]
        near = [cell for cell in range(m) if distance[cell] <= radius]
        place = view.index(torch.full((len(near),), start), torch.tensor(near))
        assert view.cells[start, place].tolist() == near
        outside = view.index(torch.tensor([start]), torch.tensor([m]))
        assert 0 <= int(outside) < view.width


def test_a_local_number_stands_for_the_same_displacement_everywhere() -> None:
    view = Window(6, 1)
    assert view.cells[7].tolist() == [0, 1, 2, 6, 7, 8, 12, 13, 14]
    assert view.cells[0].tolist() == [36, 36, 36, 36, 0, 1, 36, 6, 7]


def test_to_global_puts_local_numbers_on_their_cells() -> None:
    view = Window(6, 1)
    on = torch.zeros(36, 2, 9, dtype=torch.bool)
    on[7, 1, 8] = on[0, 0, 0] = True  # the second lies outside
    spread = view.to_global(torch.arange(36)[:, None].expand(36, 2), on)
    assert spread.shape == (36, 2, 36)
    assert spread.nonzero().tolist() == [[7, 1, 14]]


def test_cells_of_a_group_see_the_same_border() -> None:
    """6 x 6 cells, radius 1: four corners, four edges, one inside."""
    groups = Window(6, 1).groups().view(6, 6)
    assert int(groups.max()) == 8
    inside = groups[1:5, 1:5]
    assert (inside == inside[0, 0]).all()
    assert len(set(groups.flatten().tolist())) == 9
    for edge in (groups[0, 1:5], groups[5, 1:5], groups[1:5, 0], groups[1:5, 5]):
        assert (edge == edge[0]).all()
        assert edge[0] != inside[0, 0]


@given(st.integers(3, 9), st.integers(0, 4))
def test_a_group_has_the_same_window(size: int, radius: int) -> None:
    view = Window.reaching(size, radius)
    if not view.is_local:
        return
    groups, inside = view.groups(), view.cells < size**2
    for group in groups.unique():
        windows = inside[groups == group]
        assert (windows == windows[0]).all()
