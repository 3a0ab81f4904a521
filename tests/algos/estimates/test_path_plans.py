"""Exchange on recorded paths against brute force, and the choice of a plan by paths that were not counted."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from tests.algos.estimates.test_path_counts import planned
from tests.tracks import by_hand, recorded
from trackmdp.algos.estimates import path_plans
from trackmdp.algos.estimates.path_gains import AlongPaths, KeyPlans, Paths, along, thinned
from trackmdp.algos.estimates.path_plans import PRIORS, choose_plan, exchanged_keys, parted
from trackmdp.policies.table import PolicyTable, SetTable
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.solvers.value import replay


def line_walks(seed: int, count: int = 12) -> Tracks:
    """Paths on the cells 0 and 1 whose next cell depends on the last two."""
    rng, tracks = np.random.default_rng(seed), []
    chance = rng.random((2, 2))
    for _ in range(count):
        cells = [0, 1]
        for _ in range(10):
            cells.append(int(rng.random() < chance[cells[-2], cells[-1]]))
        tracks.append(cells)
    return by_hand(*tracks, exits=False)


def repeated(tracks: Tracks, times: list[int]) -> Tracks:
    """Each of the tracks so many times, all of one name for each."""
    pieces = [list(piece) for piece in np.split(tracks.cells, tracks.first[1:-1])]
    copies = [piece for piece, count in zip(pieces, times, strict=True) for _ in range(count)]
    return replace(by_hand(*copies, exits=False), names=np.repeat(tracks.names, times))


def sets_of(table: SetTable) -> np.ndarray:
    """`[plans, 2, S]`, the sets of a table."""
    assert table.sets is not None
    return np.asarray(table.sets.toarray().reshape(table.plans, 2, -1))


def earned(paths: Paths, plan: np.ndarray, points: np.ndarray, followed: AlongPaths) -> float:
    """The reward of a plan `[2, M]` after `points` up to the next detection and from there on, discounted by .9."""
    motion, task, total = paths.renewal.motion, paths.task, 0.0
    for point in points:
        gained = 0.0
        for n, after in enumerate(range(point + 1, point + 4)):
            if not motion.stay[after - 1]:  # the last point of a path
                break
            forced, cell = n == 2, motion.cell[after]
            gained -= 0.9**n * (task.safe_cost if forced else task.cost @ plan[n])
            if forced or plan[n, cell]:
                gained += 0.9**n * (task.reward + followed.value[after])
                break
        total += paths.times[point] * gained
    return total


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("first", [False, True])
def test_a_round_finds_the_best_plan_of_each_key(seed: int, first: bool) -> None:
    """t_max = 1 on two cells: 16 plans for either, what follows a detection being that of the policy before.

    Four of the paths are there three times.
    """
    tracks = repeated(line_walks(seed), [3] * 4 + [1] * 8)
    task = Recorded(
        tracks, (1, 2), validation=tracks, held_out=tracks, cost=0.4, safe_cost=0.6, t_max=1
    )
    paths = Paths(task, tracks, 0.9)
    table = SetTable(task, sparse.csr_array(np.full((4, 2), first)), 2)
    followed = paths.follow(table)
    changed = exchanged_keys(paths, table, followed, 1)
    assert changed is not None
    found = sets_of(changed(1.0))
    plans = np.array(list(itertools.product([False, True], repeat=4))).reshape(16, 2, 2)
    for key in range(2):
        # Of cells alone the events are the points, in order.
        points = np.flatnonzero((followed.visits > 0) & (paths.renewal.motion.cell == key))
        best = max(earned(paths, plan, points, followed) for plan in plans)
        assert earned(paths, found[key], points, followed) == pytest.approx(best)


@pytest.mark.parametrize("safe_detection", [1.0, 0.6])
def test_equal_paths_are_followed_once_and_count_as_often_as_they_are_there(
    safe_detection: float,
) -> None:
    """The reward is undiscounted, a safe action that misses and is repeated after one move included."""
    tracks = repeated(line_walks(1), [5, 2, *[1] * 10])
    task = recorded(tracks, detection=0.8, safe_detection=safe_detection)
    policy = PolicyTable.from_dense(task, np.random.default_rng(0).random((9, 2, 9)) < 0.5)
    paths = Paths(task, tracks, 0.9)
    assert paths.renewal.count == Paths(task, line_walks(1), 0.9).renewal.count
    assert paths.copies == pytest.approx(
        17 / len({tuple(each) for each in np.split(tracks.cells, tracks.first[1:-1])})
    )
    total = replay(task, tracks, policy).totals[:, 0].sum()
    assert along(paths, KeyPlans.of_table(policy, paths.keys)).reward == pytest.approx(total)


def test_paths_that_are_there_three_times_say_what_they_say_once_to_three_times_the_weight() -> (
    None
):
    tracks = line_walks(1)
    # At a price of .2 some gains are equal to it, but for rounding.
    task = replace(recorded(tracks, memory="displacement", clip=1), cost=np.full(9, 0.21))
    for prior in (3.0, 10.0):
        once = planned(task, tracks, prior=prior, rounds=0)
        thrice = planned(task, repeated(tracks, [3] * 12), prior=3 * prior, rounds=0)
        assert (thrice.policy.dense() == once.policy.dense()).all()
        assert thrice.reward == pytest.approx(3 * once.reward)


def test_rare_keys_keep_their_plans() -> None:
    task = recorded(line_walks(1), memory="displacement", clip=1)
    paths = Paths(task, task.tracks, 0.9)
    none = SetTable(task, sparse.csr_array((2 * len(paths.keys), 9), dtype=bool), len(paths.keys))
    followed = paths.follow(none)
    assert exchanged_keys(paths, none, followed, 10**6) is None
    some = exchanged_keys(paths, none, followed, 5)
    assert some is not None
    often = np.bincount(paths.renewal.owner, followed.visits) >= 5
    assert 0 < often.sum() < len(paths.keys)
    changed = sets_of(some(1.0)).any(axis=(1, 2))
    assert changed.any()
    assert not changed[~often].any()
    fewer = sets_of(some(0.25)).any(axis=(1, 2))
    assert 0 < fewer.sum() < changed.sum()
    assert not fewer[~changed].any()


def test_a_plan_whose_best_reward_is_negative_is_searched_until_none_is_better(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At prices above the reward; a table of the same reward is no better."""
    tracks, rounds = line_walks(1, count=60), []
    task = replace(recorded(tracks), cost=np.full(9, 1.1), safe_cost=np.float64(3.0))
    monkeypatch.setattr(path_plans, "_LEAST", 5)
    found = path_plans._searched(planned(task, tracks, prior=1.0, rounds=3))
    assert found.reward < 0

    def counted(*args: Any) -> Any:
        rounds.append(args)
        return exchanged_keys(*args)

    monkeypatch.setattr(path_plans, "exchanged_keys", counted)
    assert path_plans._searched(found).reward == found.reward
    assert len(rounds) == 1


def test_no_recording_learns_and_judges() -> None:
    tracks = line_walks(2, count=40)
    named = replace(tracks, names=np.arange(40) // 2)
    learned, judged = parted(named, 3)
    assert len(judged) == 10
    assert sorted([*learned.names, *judged.names]) == named.names.tolist()
    assert not set(learned.names) & set(judged.names)


def test_the_choice_is_the_one_that_earns_most_where_it_is_judged() -> None:
    """Of what is tried, all weights and then exchange, none earns more on the paths that judge."""
    tracks, judge = line_walks(5, count=30), line_walks(5, count=31).select(np.arange(31) > 20)
    task = recorded(tracks, memory="displacement", clip=1)
    known = planned(task, judge, prior=0.0, discount=1.0, rounds=5).policy
    found = choose_plan(
        task, tracks, judge=judge, others=[lambda *_: known], discount=1.0, rounds=5
    )
    others = [planned(task, tracks, prior=each, discount=1.0, rounds=5).policy for each in PRIORS]
    for other in (known, *others):
        assert (
            replay(task, judge, found.policy).totals[:, 0].sum()
            >= replay(task, judge, other).totals[:, 0].sum()
        )


@pytest.mark.parametrize(
    ("earned", "searched"),
    [
        ([0.995, 1.0], [0, 1]),
        ([1.0, 0.98], [0]),
        ([-1.02, -1.0], [1]),
        ([-1.0, -1.005], [0, 1]),
        ([0.0], [0]),
    ],
)
def test_exchange_begins_from_plans_that_may_end_as_the_best(
    earned: list[float], searched: list[int]
) -> None:
    assert path_plans._near(np.array(earned)) == searched


@pytest.mark.parametrize("most", [9.0, 0.0])
def test_the_best_result_is_planned_again_with_the_weight_it_began_from(
    most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two weights the second one earns more, the first one after policy iteration; or exchange from that earns 9."""
    weights, improved = list[float](), path_plans._improved

    def noted(paths: Paths, prior: float, *rest: Any) -> Any:
        weights.append(prior)
        return improved(paths, prior, *rest)

    monkeypatch.setattr(path_plans, "_improved", noted)
    monkeypatch.setattr(path_plans, "_NEAR", 10.0)
    monkeypatch.setattr(path_plans, "_first", lambda _, found: (1, found[1], most))
    earned = iter([np.array([1.0, 2.0]), np.array([3.0, 4.0])])
    monkeypatch.setattr(path_plans, "_earned", lambda *_: next(earned))
    tracks = line_walks(5, count=40)
    task = recorded(tracks, memory="displacement", clip=1)
    choose_plan(task, tracks, priors=(1.0, 100.0), discount=1.0, rounds=1)
    assert weights == [1.0, 100.0, 100.0, 1.0, 1.0]


def test_another_plan_that_is_chosen_is_made_of_all_paths_and_left_as_it_is() -> None:
    """The quarter of the paths that judges goes where the others do not: what is counted would change the plan."""
    _, judge = parted(by_hand(*[[0, 1]] * 8), 3)
    ends = [5 if name in judge.names else 1 for name in range(8)]
    tracks = by_hand(*[[0, end] for end in ends], exits=False)
    task = recorded(tracks)
    known = planned(task, parted(tracks, 3)[1], prior=0.0, discount=1.0, rounds=5).policy
    made: list[tuple[int, bool]] = []

    def other(paths: Tracks, before: PolicyTable | None) -> PolicyTable:
        made.append((len(paths), before is None))
        assert before is None or (before.dense() == known.dense()).all()
        return known

    found = choose_plan(task, tracks, others=[other], discount=1.0, rounds=5, seed=3)
    assert np.flatnonzero(found.policy.dense()[0, 0]).tolist() == [5]
    assert made == [(6, True), (8, False)]


def test_where_paths_are_left_out_the_choice_is_not_planned_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As many are left out of all of them: only the paths would be others, and the judges among them."""
    tracks = line_walks(5, count=40)
    task = recorded(tracks, memory="displacement", clip=1)
    known = planned(task, tracks, prior=0.0, discount=1.0, rounds=0).policy
    made: list[int] = []

    def other(paths: Tracks, before: PolicyTable | None) -> PolicyTable:
        made.append(len(paths))
        return known

    for most, times in ((10_000, [30, 40]), (300, [30])):
        monkeypatch.setattr(path_plans, "_MOST", most)
        made.clear()
        choose_plan(task, tracks, priors=(), others=[other], discount=1.0, rounds=0)
        assert made == times


def test_some_of_many_paths_have_as_many_events_as_asked_for() -> None:
    tracks = line_walks(2, count=400)
    task = recorded(tracks, memory="displacement", clip=1)
    events = Paths(task, tracks, 1.0).renewal.count
    some = Paths(task, thinned(task, tracks, events // 4, 0), 1.0).renewal.count
    assert events / 5 < some < events / 3
    assert thinned(task, tracks, 2 * events, 0) is tracks


def test_where_all_paths_are_one_there_is_nothing_to_choose_by() -> None:
    tracks = replace(by_hand(*[[0, 1, 2, 1]] * 8, exits=False), names=np.zeros(8, dtype=np.int64))
    task = recorded(tracks)
    found = choose_plan(task, tracks, discount=0.9, rounds=5)
    assert (
        found.policy.dense() == planned(task, tracks, prior=10.0, rounds=5).policy.dense()
    ).all()


def test_what_is_asked_for_is_what_the_table_of_all_keys_says() -> None:
    """Keys that the paths lead to, such that they do not, and some whose sets were replaced."""
    task = recorded(line_walks(3), memory="two_displacements", clip=1)
    paths = Paths(task, task.tracks, 0.9)
    plans = planned(task, task.tracks, prior=3.0, rounds=3).plans
    every = sparse.csr_array(np.ones((2 * len(paths.keys), 9), dtype=bool))
    changed = replace(plans, table=SetTable(task, every, len(paths.keys)))
    for each in (plans, changed, KeyPlans.of_table(plans.policy(), paths.keys[::2])):
        table = each.policy().dense()
        keys = np.random.default_rng(0).permutation(np.concatenate([paths.keys, np.arange(200)]))
        assert (sets_of(each.on(keys).table) == table[keys]).all()
        assert table.any()
    assert changed.policy().dense()[paths.keys].all()
    unseen = np.delete(np.arange(task.num_keys), paths.keys)
    assert (changed.policy().dense()[unseen] == plans.policy().dense()[unseen]).all()
