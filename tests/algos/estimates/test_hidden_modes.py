"""Motions with hidden modes: expected moves by enumeration, and what is learned of targets that keep a heading."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import trackmdp as tm
from tests.tracks import by_hand
from trackmdp.algos.estimates import hidden_modes
from trackmdp.algos.estimates.hidden_modes import _Paths, fit_modes
from trackmdp.recordings.tracks import Tracks

TASK = tm.World(np.full((3, 3), 0.3), (1, 3), cost=0.16, t_max=1, memory="displacement")
TRACKS = by_hand([0, 1, 2], [2, 1, 1, 0], [1], exits=[True, False, False])
"""From the left to the right and out of the grid; back, with a stop; a recording of one cell."""
PAIRS = [(0, 1), (1, 0), (1, 1), (1, 2), (2, 1), (2, 3)]
KEPT = 0.9


def around(count: int, steps: int, seed: int) -> Tracks:
    """Tracks around the cells 0 1 3 2 of a square; a target turns round in a tenth of its moves."""
    rng = np.random.default_rng(seed)
    turns = np.where(rng.random((count, steps)) < KEPT, 1, -1)
    turns[:, 0] = rng.choice([-1, 1], count)
    place = np.cumsum(np.cumprod(turns, axis=1), axis=1)
    return by_hand(*np.array([0, 1, 3, 2])[place % 4], exits=False)


def of(tracks: Tracks, cells: int = 3) -> _Paths:
    """All moves of the tracks."""
    return _Paths.of(tracks, cells, 10**6, np.random.default_rng(0))


def test_pairs_and_steps_are_those_of_the_tracks() -> None:
    """The longest track first: 2 1, then 1 1, then 1 0; beside it 0 1, then 1 2, then the exit from 2."""
    paths = of(TRACKS)
    assert list(zip(paths.before, paths.after, strict=True)) == PAIRS
    assert paths.share == pytest.approx([1, 1 / 3, 1 / 3, 1 / 3, 0.5, 0.5])
    moves = [[PAIRS[place] for place in step] for step in paths.steps]
    assert [sorted(step) for step in moves] == [
        [(0, 1), (2, 1)],
        [(1, 1), (1, 2)],
        [(1, 0), (2, 3)],
    ]


def test_expected_moves_are_those_of_all_modes_a_path_may_have() -> None:
    """Each way through two modes has its probability; the moves on it count by its share of all ways."""
    paths = of(TRACKS)
    moves = paths.normed(np.random.default_rng(3).random((6, 2, 2)))
    expected, likelihood = np.zeros((6, 2, 2)), 0.0
    for track in ([(0, 1), (1, 2), (2, 3)], [(2, 1), (1, 1), (1, 0)]):
        pairs = [PAIRS.index(pair) for pair in track]
        ways = list(itertools.product(range(2), repeat=4))
        chance = np.array(
            [
                0.5 * np.prod([moves[p, *way[n : n + 2]] for n, p in enumerate(pairs)])
                for way in ways
            ]
        )
        likelihood += np.log(chance.sum())
        for way, share in zip(ways, chance / chance.sum(), strict=True):
            for n, pair in enumerate(pairs):
                expected[pair, way[n], way[n + 1]] += share
    found, reached = paths._expected(moves)
    assert found == pytest.approx(expected)
    assert reached == pytest.approx(likelihood)


def test_a_round_makes_the_tracks_likelier() -> None:
    paths = of(around(40, 30, 0), 4)
    moves, reached = paths.normed(np.random.default_rng(0).random((8, 3, 3))), []
    for _ in range(12):
        moves, likelihood = paths.fitted(moves)
        reached.append(likelihood)
    assert (np.diff(reached) > -1e-3).all()
    assert reached[-1] > reached[0] + 50


def test_exits_are_not_spared_and_lead_to_no_mode() -> None:
    """Spared a whole count of moves, only exits are left, beside the floor of the moves from 2 to 1."""
    paths = of(TRACKS)
    moves = paths.normed(paths.ending(np.random.default_rng(3).random((6, 2, 2))))
    spared, _ = paths.fitted(moves, 1.0)
    leaves = spared[PAIRS.index((2, 3))]
    assert (leaves[:, 0] > 0.9).all()
    assert (leaves[:, 1] == 0).all()


def test_a_target_that_keeps_its_heading_is_predicted_from_its_last_move() -> None:
    """From 0 to 1, then on to 3 with probability .9, back to 0 with .1; half and half by the cell alone."""
    world = fit_modes(around(300, 40, 1), 4, 2, seed=0).world(square(), 0.0)
    kernel = world.kernel.toarray().reshape(4, 2, 4, 2)
    then = kernel[0, :, 1].sum(axis=0) @ kernel[1].sum(axis=2)
    assert then[3] / then.sum() == pytest.approx(KEPT, abs=0.03)


def test_of_more_tracks_an_earlier_fit_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Among them a move, from 0 to 3, that the earlier tracks did not show."""
    tracks = around(300, 40, 1)
    before = fit_modes(tracks, 4, 2, seed=0)
    monkeypatch.setattr(hidden_modes, "_guessed", None)
    more = by_hand(*np.split(tracks.cells, tracks.first[1:-1]), *[[0, 3]] * 9, exits=False)
    again = fit_modes(more, 4, 2, seed=0, before=before).world(square(), 0.0)
    kernel = again.kernel.toarray().reshape(4, 2, 4, 2)
    then = kernel[0, :, 1].sum(axis=0) @ kernel[1].sum(axis=2)
    assert then[3] / then.sum() == pytest.approx(KEPT, abs=0.03)
    assert kernel[0, :, 3].sum() > 0
    assert (before.world(square(), 0.0).kernel.toarray().reshape(4, 2, 4, 2)[0, :, 3] == 0).all()


def square() -> tm.World:
    """Where the targets of `around` move."""
    return tm.World(np.full((4, 4), 0.2), 2, cost=0.16, t_max=1, memory="displacement")


def test_every_move_that_was_seen_stays_possible_and_exits_are_left_over() -> None:
    world = fit_modes(TRACKS, 3, 3, seed=0).world(TASK, 0.0)
    assert (world.modes, world.memory, world.max_steps) == (3, "displacement", None)
    chance = world.kernel.toarray().reshape(3, 3, 3, 3).sum(axis=(1, 3))
    assert {*zip(*np.nonzero(chance), strict=True)} == {*PAIRS[:-1]}
    assert chance[:2].sum(axis=1) == pytest.approx(3 * (1 - 0.5 / 7))
    assert 0.5 < chance[2].sum() < 2.5


def test_of_recordings_of_one_cell_each_the_target_leaves_at_once() -> None:
    world = fit_modes(by_hand([0], [1], exits=False), 3, 2, seed=0).world(TASK, 0.0)
    assert world.kernel.nnz == 0


def test_the_seed_is_all_that_is_random() -> None:
    one, same, other = (fit_modes(TRACKS, 3, 3, seed=seed).moves for seed in (0, 0, 1))
    assert (one == same).all()
    assert not (one == other).all()


def test_pairs_that_few_tracks_do_not_show_come_in_with_the_floor() -> None:
    few, paths = of(by_hand([0, 1, 2])), of(TRACKS)
    moves = few.on(paths, few.normed(np.ones((3, 2, 2))))
    total = np.zeros((3, 2))
    np.add.at(total, paths.before, moves.sum(axis=2))
    assert total == pytest.approx(1)
    assert 0 < moves[PAIRS.index((1, 0))].max() < 0.01


def test_some_tracks_have_so_many_moves_or_few_more() -> None:
    tracks = around(10, 7, 0)
    counts = [_Paths.of(tracks, 4, most, np.random.default_rng(0)).count for most in (3, 6, 20, 99)]
    assert counts == [6, 6, 24, 60]


def test_long_tracks_are_cut() -> None:
    """250 moves: 100, 100 and 50."""
    paths = _Paths.of(around(1, 251, 0), 4, 1_000, np.random.default_rng(0))
    assert [len(step) for step in paths.steps] == [3] * 50 + [2] * 50


@pytest.mark.long
def test_a_velocity_is_learned_from_its_moves() -> None:
    """Plans on paths alone stop .004 to .009 a step below the policy found on the motion."""
    world = tm.make_world("constant_velocity", size=3, memory="displacement")
    best = tm.evaluate(world, tm.solve(world).policy)
    run = tm.train(world, "model_based", seed=11, **{"optimal.enabled": False})
    regret = best.aihtr - tm.evaluate(world, run.policy).aihtr
    assert regret / best.expected_length < 0.004
