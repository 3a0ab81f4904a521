"""Policies that remember more than the cell, on recorded tracks: valued by hand and step by step, and planned."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.tracks import by_hand, recorded
from trackmdp.algos.estimates.path_counts import Planned, plan_paths
from trackmdp.algos.estimates.path_gains import Paths
from trackmdp.config.world import MEMORIES
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.sensing.task import Task
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.value import replay

SWEEP = (0, 1, 2, 5, 2, 1)
"""To and fro, the corner 0 to the middle 5 of the right side: from 1 and 2 the next cell depends on the direction."""


def planned(
    task: Task, tracks: Tracks, *, prior: float, discount: float = 0.9, rounds: int
) -> Planned:
    return plan_paths(Paths(task, tracks, discount), prior=prior, rounds=rounds)


def random_policy(task: Recorded, rng: np.random.Generator, *, draws: bool) -> PolicyTable:
    on = rng.random((task.num_keys * task.num_choices, task.num_cells))
    return PolicyTable(task, sparse.csr_array(np.where(on < 0.4, on, 0.0) if draws else on < 0.3))


def walks(seed: int, count: int = 6, *, side: int = 3) -> Tracks:
    rng = np.random.default_rng(seed)
    tracks = []
    for _ in range(count):
        row, column, cells = rng.integers(side), rng.integers(side), []
        for _ in range(rng.integers(5, 12)):
            row, column = (row + rng.integers(-1, 2)) % side, (column + rng.integers(-1, 2)) % side
            cells.append(int(row * side + column))
        tracks.append(cells)
    return by_hand(*tracks, exits=[bool(number % 2) for number in range(count)])


def step_by_step(task: Recorded, track: list[int], exits: bool, policy: PolicyTable) -> float:
    """What a policy that does not draw earns on one track, as the environment's rules say."""
    table, keys = policy.dense(), policy.task.keys
    key, n, total = int(keys.start(track[0])), 0, 0.0
    for cell in track[1:]:
        forced = n > task.t_max
        on = table[key, min(n, task.t_max)]
        total -= task.safe_cost if forced else task.cost @ on
        if forced or on[cell]:
            total += task.reward
            key, n = int(keys.next(np.int64(key), n, np.int64(cell))), 0
        else:
            n += 1
    return total


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("t_max", [0, 1, 2])
def test_the_replay_is_the_game_step_by_step(memory: str, t_max: int) -> None:
    task = recorded(walks(1), t_max=t_max, memory=memory, clip=1)
    policy = random_policy(task, np.random.default_rng(2), draws=False)
    tracks = task.tracks
    cells = np.split(tracks.cells, tracks.first[1:-1])
    alone = [
        step_by_step(task, list(part), bool(e), policy)
        for part, e in zip(cells, tracks.exits, strict=True)
    ]
    assert replay(task, tracks, policy).totals[:, 0] == pytest.approx(alone)


@pytest.mark.parametrize(
    "memory", [*MEMORIES][1:]
)  # with the cell alone the start's key comes again
def test_a_policy_that_draws_is_worth_the_mean_of_its_draws(memory: str) -> None:
    """One sensor with probability .4 in one state of the key, every other choice fixed: the mixture of two policies."""
    task = recorded(walks(4), memory=memory, clip=1)
    base = random_policy(task, np.random.default_rng(5), draws=False)
    key = task.keys.start(int(task.tracks.cells[0]))
    found = []
    for share in (0.0, 1.0, 0.4):
        table = base.dense().astype(np.float64)
        table[key, 0, :] = share
        found.append(replay(task, task.tracks, PolicyTable.from_dense(task, table)).totals[0, 0])
    # The start's key occurs once a track, and the other sensors of the state do not decide where the target is found.
    assert found[2] == pytest.approx(0.6 * found[0] + 0.4 * found[1])


def test_what_a_policy_remembers_is_its_own() -> None:
    """A policy of the cell alone is worth the same in a task of more memory."""
    task = recorded(walks(6))
    policy = random_policy(task, np.random.default_rng(7), draws=False)
    assert (
        evaluate(replace(task, memory="displacement", clip=1), policy).aihtr
        == evaluate(task, policy).aihtr
    )


def test_memory_is_worth_what_the_zigzag_says() -> None:
    """13 cells of the sweep and 12 moves, c = .2: with the direction one sensor always hits, .8 a move.

    The cell alone senses both sides from 1 and 2, 8 of the moves, at .6; from the ends one sensor does, 4 moves.
    """
    track = [SWEEP[number % 6] for number in range(13)]
    tracks = by_hand(*[track] * 20, exits=False)
    known = {}
    for memory in ("cell", "displacement"):
        task = recorded(tracks, memory=memory, clip=1)
        found = planned(task, task.tracks, prior=0.0, rounds=5)
        known[memory] = evaluate(task, found.policy).aihtr
        assert known[memory] == pytest.approx(found.reward / 20)
        assert found.paths.moves == 20 * 12
    # The very first move, from cell 0, is known to all.
    assert known["displacement"] == pytest.approx(12 * 0.8)
    assert known["cell"] == pytest.approx(4 * 0.8 + 8 * 0.6)


def test_planning_is_the_best_there_is_on_a_tiny_recording() -> None:
    """Brute force over all plans of a 1 x 3 line with t_max = 0: 2^3 sets for each of the 3 located cells."""
    tracks = by_hand([0, 1, 0, 1, 2, 1], [1, 2, 1, 0, 1, 0], [2, 1, 2, 1, 0, 0], exits=False)
    task = Recorded(
        tracks, (1, 3), validation=tracks, held_out=tracks, cost=0.3, safe_cost=1.1, t_max=0
    )
    best = -np.inf
    sets = list(itertools.product([False, True], repeat=3))
    for choice in itertools.product(sets, repeat=3):
        table = np.array(choice, dtype=bool)[:, None]
        best = max(best, evaluate(task, table).aihtr)
    found = planned(task, tracks, prior=0.0, discount=1.0, rounds=10)
    assert evaluate(task, found.policy).aihtr == pytest.approx(best)


def test_keys_never_seen_follow_what_is_shared() -> None:
    """All targets go one to the right; a key of another row knows it from the displacement alone."""
    task = recorded(by_hand(*[[0, 1, 2]] * 30), memory="displacement", clip=1)
    found = planned(task, task.tracks, prior=5.0, rounds=2).policy.dense()
    right = 1 + 1 * 3 + 2
    assert found[3 * 10 + right, 0].nonzero()[0].tolist() == [4]
    assert found[5 * 10 + right, 0].sum() == 0  # at the border there is nothing to the right


def test_a_key_never_seen_is_told_by_its_cell_and_its_class() -> None:
    """After a move to the right, half go on to the right and half down; from the centre, 4, nobody goes to the right.

    Nobody was seen to come to 4 from the left, so that its class alone would have both sensed (each at 1/2 > .2).
    """
    told = by_hand(*[[0, 1, 2]] * 30, *[[0, 1, 4, 7]] * 30, *[[6, 7, 8]] * 30)
    task = recorded(told, memory="displacement", clip=1)
    sets = planned(task, told, prior=1.0, rounds=2).policy.dense()[:, 0]
    right = 1 + 1 * 3 + 2
    assert sets[1 * 10 + right].nonzero()[0].tolist() == [2, 4]
    assert sets[4 * 10 + right].nonzero()[0].tolist() == [7]
    assert sets[5 * 10 + right].nonzero()[0].tolist() == [
        8
    ]  # never seen at all, and to the right is outside


def test_the_window_limits_the_sets() -> None:
    tracks = by_hand(*[[0, 2, 0, 2, 0, 2]] * 10, exits=False)
    far = recorded(tracks)
    near = replace(far, window=1)
    assert planned(far, tracks, prior=0.0, rounds=2).policy.dense()[0, 0].nonzero()[0].tolist() == [
        2
    ]
    assert planned(near, tracks, prior=0.0, rounds=2).policy.dense()[:, 0].sum() == 0
