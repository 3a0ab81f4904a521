from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.helpers import collect, small_world
from trackmdp.algos.moves import MoveBuffer, sensed_moves
from trackmdp.policies.acting import Exploring
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World

M = 9
TASK = small_world()


def batch(start: list[int], end: list[int], **changed: list[bool]) -> TensorDict:
    """One row of fully sensed steps, apart from what is `changed`."""
    count = len(start)
    flags = {
        "partial": [False] * count,
        "missed": [False] * count,
        "unknown": [False] * count,
        "exited": [False] * count,
    }
    partial, missed, unknown, exited = (torch.tensor([row]) for row in (flags | changed).values())
    action = torch.ones(1, count, M, dtype=torch.bool)
    action[..., 0] = ~partial
    after = {
        "last_cell": torch.tensor([end]),
        "steps_since_detection": missed.long(),
        "terminated": exited.unsqueeze(-1),
        "done": exited.unsqueeze(-1),
    }
    state = {
        "last_cell": torch.tensor([start]),
        "steps_since_detection": unknown.long(),
        "action": action,
        "next": after,
    }
    return TensorDict(state, [1, count])


def filled(start: list[int], end: list[int], *, capacity: int = 100, seed: int = 0) -> MoveBuffer:
    buffer = MoveBuffer(TASK, capacity, torch.Generator().manual_seed(seed))
    for before, after in zip(start, end, strict=True):
        buffer.extend(batch([before], [after], exited=[after == M]))
    return buffer


def test_moves_are_those_of_fully_sensed_steps() -> None:
    steps = batch(
        [0, 1, 2, 3, 4],
        [1, 2, 3, 4, 4],
        partial=[False, True, False, False, False],
        missed=[False, False, False, True, False],
        unknown=[False, False, False, False, False],
        exited=[False, False, False, False, True],
    )
    start, end = sensed_moves(steps, M)
    assert start.tolist() == [0, 2, 4]
    assert end.tolist() == [1, 3, M]


def test_a_step_from_an_unknown_cell_is_no_move() -> None:
    start, end = sensed_moves(batch([0, 1], [1, 2], unknown=[True, False]), M)
    assert (start.tolist(), end.tolist()) == ([1], [2])


def test_paths_start_everywhere_and_leave_in_the_proportions_seen() -> None:
    buffer = filled([cell for cell in range(M) for _ in range(4)], [1, 1, 2, M] * M)
    cells = buffer.paths(40 * M, 1)
    assert torch.bincount(cells[0], minlength=M).tolist() == [40] * M
    for cell in range(M):
        left = torch.bincount(cells[1][cells[0] == cell], minlength=M + 1)
        assert left[[1, 2, M]].tolist() == [20, 10, 10]


def test_later_moves_have_the_proportions_seen() -> None:
    buffer = filled([0, 1, 1, 1, 1], [1, 5, 5, 5, 6])
    cells = buffer.paths(8000 * M, 2)
    second = torch.bincount(cells[2][cells[0] == 0], minlength=M + 1)
    assert second[5] + second[6] == 8000
    assert abs(int(second[6]) - 2000) < 4 * (8000 * 0.25 * 0.75) ** 0.5


def test_few_paths_start_in_other_cells_each_time() -> None:
    buffer = filled(list(range(M)), [0] * M)
    starts = {int(cell) for _ in range(100) for cell in buffer.paths(2, 1)[0]}
    assert starts == set(range(M))


def test_outside_is_for_good_and_ends_paths_from_unseen_cells() -> None:
    buffer = filled([0, 1], [3, M])
    cells = buffer.paths(M, 3)
    path = {int(column[0]): column[1:].tolist() for column in cells.T}
    assert path[0] == [3, M, M]
    assert path[1] == [M, M, M]
    assert path[7] == [M, M, M]


def test_the_oldest_moves_go_first() -> None:
    buffer = filled([0, 1, 2], [0, 0, 0], capacity=2)
    assert sorted(buffer.moves()[0].tolist()) == [1, 2]


def deviations(start: torch.Tensor, end: torch.Tensor, world: World) -> torch.Tensor:
    """`[M, M + 1]` by how many standard errors the moves seen out of each cell miss the motion; 0 where it has none."""
    m = world.num_cells
    kernel = torch.as_tensor(
        np.column_stack([world.kernel.toarray(), 1.0 - world.stay_probability])
    )
    counts = torch.bincount(start * (m + 1) + end, minlength=m * (m + 1)).view(m, m + 1)
    seen = counts.sum(1, keepdim=True)
    error = (kernel * (1 - kernel) / seen).sqrt()
    assert (counts[kernel < 1e-12] == 0).all()
    return torch.where(kernel > 1e-12, (counts / seen - kernel).abs() / error, 0.0)


def test_a_mixture_shows_the_motion_as_it_is() -> None:
    """The chains look where the target is likeliest, so what is located at all is far from the motion.

    What is sensed whole is not, since the coin for it falls before the target moves.
    """
    world = small_world()
    chains = np.zeros((9, 2, 9), dtype=bool)
    chains[np.arange(9), 0, world.kernel.toarray().argmax(1)] = True
    policy = Exploring(world)
    policy.renew(Policy.from_dense(world, chains))
    policy.explore.fill_(0.3)
    torch.manual_seed(0)
    frames = collect(world, policy, 128, 800)
    whole = deviations(*sensed_moves(frames, 9), world)
    assert whole.max() < 5
    after, exited = frames["next"], frames["next", "terminated"].squeeze(-1)
    located = (frames["steps_since_detection"] == 0) & (
        (after["steps_since_detection"] == 0) | exited
    )
    end = torch.where(exited, 9, after["last_cell"])
    naive = deviations(frames["last_cell"][located], end[located], world)
    assert naive.max(1).values.median() > 10


@given(st.integers(1, 60), st.integers(1, 100), st.integers(1, 4), st.integers(0, 2**31))
def test_paths_are_made_of_moves_seen(moves: int, count: int, steps: int, seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    start = torch.randint(M, (moves,), generator=rng).tolist()
    end = torch.randint(M + 1, (moves,), generator=rng).tolist()
    cells = filled(start, end, seed=seed).paths(count, steps)
    seen = set(zip(start, end, strict=True)) | {
        (cell, M) for cell in range(M + 1) if cell not in start
    }
    assert cells.shape == (steps + 1, count)
    assert (
        set(zip(cells[:-1].flatten().tolist(), cells[1:].flatten().tolist(), strict=True)) <= seen
    )


def test_a_saved_buffer_draws_the_same_paths() -> None:
    buffer, other = (
        filled([0, 0, 1], [1, 2, 0], seed=3),
        MoveBuffer(TASK, 100, torch.Generator().manual_seed(3)),
    )
    other.load_state_dict(buffer.state_dict())
    assert torch.equal(buffer.paths(50, 4), other.paths(50, 4))


def test_however_moves_come_they_are_kept_in_order() -> None:
    rng = torch.Generator().manual_seed(0)
    start, end = (torch.randint(M, (60,), generator=rng).tolist() for _ in range(2))
    one = MoveBuffer(TASK, 50, torch.Generator())
    for size, begin in ((1, 0), (2, 1), (40, 3), (17, 43)):
        one.extend(batch(start[begin : begin + size], end[begin : begin + size]))
        assert len(one) == min(begin + size, 50)
    assert one.moves()[0].tolist() == start[-50:]
    assert one.moves()[1].tolist() == end[-50:]
    assert len(one) == 50
