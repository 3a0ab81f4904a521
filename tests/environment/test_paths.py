"""The sampler agrees with the table it is derived from, to the last draw."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse, stats

from tests.helpers import random_kernel
from tests.tracks import by_hand, recorded
from trackmdp.environment.paths import RESOLUTION, PathSampler, path_sampler
from trackmdp.errors import UserError
from trackmdp.motion.chain import Motion

LARGEST = 1.0 - 1.0 / RESOLUTION


def sampler_of(kernel: sparse.csr_array | np.ndarray) -> PathSampler:
    """The sampler of a target whose states are the cells."""
    return PathSampler(Motion.of(sparse.csr_array(kernel)), kernel.shape[0])


def moved(sampler: PathSampler, cells: torch.Tensor, draws: object) -> torch.Tensor:
    """Next cells for uniform draws in [0, 1), one for all or one each."""
    numbers = torch.as_tensor(draws, dtype=torch.float64) * RESOLUTION
    return sampler.move(cells, numbers.long().expand(cells.shape).contiguous())


def closed(kernel: np.ndarray) -> np.ndarray:
    """The table with the exit as its last column."""
    return np.append(kernel, 1.0 - kernel.sum(axis=1, keepdims=True), axis=1)


@st.composite
def kernels(draw: st.DrawFn) -> np.ndarray:
    """Tables of up to 30 cells: rows of one cell, of all cells, of tiny probabilities; exits of 0, 1e-6 and more."""
    m = draw(st.sampled_from([1, 4, 9, 30]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    table = random_kernel(
        rng, m, draw(st.sampled_from([0.0, 1e-6, 0.3])), draw(st.sampled_from([0.0, 0.2, 1.0]))
    )
    tiny = rng.random((m, m)) < draw(st.sampled_from([0.0, 0.3]))
    return np.where(tiny, table * 1e-13, table)


@given(kernels(), st.integers(0, 2**32 - 1))
def test_a_cell_of_probability_zero_is_never_reached(kernel: np.ndarray, seed: int) -> None:
    m = len(kernel)
    motion, possible = (
        sampler_of(kernel),
        np.append(kernel > 0, closed(kernel)[:, -1:] > 1e-15, axis=1),
    )
    edges = np.floor(np.cumsum(closed(kernel), axis=1) * 2**40)
    near = [edges + step for step in (-2, -1, 0, 1, 2)]
    draws = np.concatenate(
        [*near, np.zeros((m, 1)), np.floor(np.random.default_rng(seed).random((m, 20)) * 2**40)], 1
    )
    draws = torch.as_tensor(np.clip(draws, 0, 2**40 - 1) / 2**40)
    cells = torch.arange(m).repeat_interleave(draws.shape[1])
    assert possible[cells, moved(motion, cells, draws.flatten())].all()


@pytest.mark.parametrize("exit_probability", [0.0, 1e-6, 0.3])
def test_each_successor_has_its_own_stretch_of_draws(exit_probability: float) -> None:
    """Just below and just above every edge of every row: nowhere is the sampler off the table by more than 2^-37."""
    kernel = random_kernel(np.random.default_rng(0), 40, exit_probability)
    kernel = np.where(kernel > 1e-6, kernel, 0.0)
    motion, table, step = sampler_of(kernel), closed(kernel), 2.0**-37
    for cell, row in enumerate(table):
        successors = np.flatnonzero(row > 1e-9)
        ends = np.cumsum(row)[successors]
        below = moved(motion, torch.full((len(ends),), cell), torch.as_tensor(ends - step))
        assert below.tolist() == successors.tolist()
        above = moved(motion, torch.full((len(ends) - 1,), cell), torch.as_tensor(ends[:-1] + step))
        assert above.tolist() == successors[1:].tolist()


def test_the_last_cells_of_a_large_grid_are_sampled_as_finely() -> None:
    """64 x 64 cells, exit 1e-6: the exit owns exactly the last millionth of the draws of every cell."""
    m = 4096
    kernel = np.zeros((m, m))
    kernel[np.arange(m), np.arange(m)[::-1]] = 1 - 1e-6
    motion, cells = sampler_of(kernel), torch.arange(m)
    stays = moved(motion, cells, 1 - 1e-6 - 2.0**-38)
    leaves = moved(motion, cells, 1 - 1e-6 + 2.0**-38)
    assert torch.equal(stays, cells.flip(0))
    assert (leaves == m).all()
    assert torch.equal(moved(motion, cells, torch.zeros(m, dtype=torch.float64)), cells.flip(0))
    assert (moved(motion, cells, LARGEST) == m).all()


def test_a_million_cells_are_sampled_as_finely() -> None:
    """2^20 cells, each with two successors; the draws next to the edge between them fall on its two sides."""
    m = 2**20
    cells, edge = np.arange(m), 0.3
    table = (
        np.tile([edge, 0.7 - 1e-6], m),
        (np.repeat(cells, 2), np.sort([cells, cells ^ 1], axis=0).T.ravel()),
    )
    motion, some = (
        sampler_of(sparse.csr_array(table, shape=(m, m))),
        torch.tensor([0, 5, m // 2, m - 1]),
    )
    first, second = some & ~1, some | 1
    below, above = np.ceil(edge * 2**40) - 1, np.ceil(edge * 2**40)
    for draw, expected in ((0, first), (below, first), (above, second)):
        draws = draw / 2**40
        assert torch.equal(moved(motion, some, draws), expected)
    left = 1 - 1e-6 + 2.0**-39
    assert (moved(motion, some, left) == m).all()


def test_more_cells_than_the_line_holds_are_refused() -> None:
    wide = (np.full(40, 0.02), (np.zeros(40, dtype=np.int64), np.arange(40)))
    with pytest.raises(UserError, match="8,388,607 states, expected at most 8,388,606"):
        sampler_of(sparse.csr_array(wide, shape=(2**23 - 1, 2**23 - 1)))


def test_a_row_that_sums_to_a_little_more_than_one_stays_in_its_row() -> None:
    """Row sums up to 1 + 1e-9 are accepted; a last cell smaller than that excess must not shift the next row."""
    kernel = np.eye(9) * (1 + 9e-10)
    kernel[:8, 8] = 1e-12
    motion, cells = sampler_of(kernel), torch.arange(9)
    for draw in (0.0, 2.0**-40, 2.0**-31, 0.4):
        assert torch.equal(moved(motion, cells, draw), cells)
    last = moved(motion, cells, LARGEST)
    assert ((last == cells) | (last == 8)).all()


def test_as_many_recorded_points_as_cells_are_no_cells() -> None:
    tracks = by_hand([3, 2], [1, 0])
    sampler = path_sampler(recorded(tracks, size=2, anywhere=True))
    assert sampler.starts == sampler.num_states == 4
    assert sampler.cell(torch.arange(5)).tolist() == [3, 2, 1, 0, 4]


def test_an_exited_target_stays_away() -> None:
    motion = sampler_of(random_kernel(np.random.default_rng(1), 9, 0.1))
    draws = torch.tensor([0.0, 0.5, LARGEST], dtype=torch.float64)
    assert moved(motion, torch.full((3,), 9), draws).tolist() == [9, 9, 9]


def test_draws_are_uniform_on_their_grid_and_the_generators_alone() -> None:
    motion = sampler_of(random_kernel(np.random.default_rng(1), 4, 0.1))
    draws = motion.draw(100_000, torch.Generator().manual_seed(5))
    torch.rand(3)
    assert torch.equal(draws, motion.draw(100_000, torch.Generator().manual_seed(5)))
    assert draws.dtype == torch.int64
    assert ((draws >= 0) & (draws < RESOLUTION)).all()
    assert len(draws.unique()) > 99_990
    assert stats.kstest(draws.numpy() / RESOLUTION, "uniform").pvalue > 1e-3


def test_frequencies_are_those_of_the_table() -> None:
    kernel = random_kernel(np.random.default_rng(2), 9, 0.05)
    motion, rng, count = (
        sampler_of(kernel),
        torch.Generator().manual_seed(0),
        100_000,
    )
    for cell in range(9):
        ends = motion.move(torch.full((count,), cell), motion.draw(count, rng))
        observed = np.bincount(ends.numpy(), minlength=10)
        expected = closed(kernel)[cell] * count
        assert not observed[expected < 1e-9].any()
        likely = expected > 5
        assert (
            stats.chisquare(
                observed[likely], expected[likely] * observed[likely].sum() / expected[likely].sum()
            )[1]
            > 1e-3
        )


@given(kernels(), st.integers(0, 2**32 - 1))
def test_padded_rows_give_the_answers_of_one_line(kernel: np.ndarray, seed: int) -> None:
    """Short rows are padded, and searched one by one; long rows lie on one line, and so do all with _SHORT = -1."""
    m, table = len(kernel), sparse.csr_array(kernel)
    padded = sampler_of(table)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trackmdp.environment.paths._SHORT", -1)
        line = sampler_of(table)
    edges = np.floor(np.cumsum(closed(kernel), axis=1) * RESOLUTION)
    near = np.concatenate([edges + step for step in (-1, 0, 1)], axis=1)
    anywhere = np.random.default_rng(seed).integers(RESOLUTION, size=(m, 9))
    draws = np.append(np.clip(near, 0, RESOLUTION - 1).astype(np.int64), anywhere, axis=1)
    # The exit, state M, as well.
    cells = torch.arange(m + 1).repeat_interleave(draws.shape[1])
    numbers = torch.as_tensor(np.append(draws, draws[:1], axis=0)).flatten()
    assert torch.equal(padded.move(cells, numbers), line.move(cells, numbers))
