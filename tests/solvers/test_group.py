"""Several targets that share sensors: exact on tiny worlds, between proved bounds, and simulated alike."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.helpers import later
from tests.solvers.worlds import random_tiny_world
from trackmdp.arrays.types import Array, IndexArray
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.several import group_bounds
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.several.group_bounds import equal_shares, upper_bound
from trackmdp.solvers.several.group_chain import explored
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.merging import Rule, make_rule
from trackmdp.solvers.solve import solve
from trackmdp.world.group import Group
from trackmdp.world.model import World


def tiny(seed: int, t_max: int = 0, **options: Any) -> World:
    """Three cells, prices that differ, and a safe action as dear as all sensors or dearer."""
    rng = np.random.default_rng(seed)
    kernel = rng.random((3, 3)) ** rng.choice([1.0, 3.0])
    kernel *= 0.75 / kernel.sum(axis=1, keepdims=True)
    cost = rng.choice([0.1, 0.2, 0.35]) * (0.5 + rng.random(3))
    given: dict[str, Any] = {"cost": cost, "safe_cost": float(cost.sum() * rng.choice([1.0, 2.0]))}
    return World(kernel, (1, 3), t_max=t_max, **(given | options))


def best_of_all(group: Group) -> float:
    """V* from a uniform start: every set tried in every joint state, by value iteration."""
    sensors = np.flatnonzero(group.task.available).tolist()
    sets: list[IndexArray] = [
        np.array(each, dtype=np.int64)
        for k in range(len(sensors) + 1)
        for each in itertools.combinations(sensors, k)
        if group.task.budget is None or k <= group.task.budget
    ]
    chain = explored(group, lambda _: sets, 10_000)
    assert chain is not None
    value: Array = np.zeros(chain.moves.shape[1])
    for step in itertools.count(1):
        worth = chain.totals[:, 0] + chain.moves @ value
        after = np.full(chain.moves.shape[1], -np.inf)
        np.maximum.at(after, chain.owner, worth)
        if np.abs(after - value).max() < 1e-11 or step == group.task.max_steps:
            break
        value = after
    return float(after[: (group.states // group.hidden) ** len(group)].mean())


def check_figures(rule: Rule, best: float, episodes: int) -> None:
    """The exact figures of a policy are no better than the best, and those of so many episodes are alike."""
    exact, played = evaluate_group(rule), evaluate_group(rule, episodes=episodes)
    assert exact.exact
    assert exact.aihtr.mean <= best + 1e-9
    assert played.aihtr.low is not None
    half = played.aihtr.mean - played.aihtr.low
    assert abs(played.aihtr.mean - exact.aihtr.mean) < 2 * half + 1e-9


def check_bracket(group: Group) -> None:
    found, best = solve(group), best_of_all(group)
    assert found.lower is not None
    assert found.lower <= best + 1e-9
    assert best <= found.upper + 1e-9
    assert found.upper <= equal_shares(group) + 1e-9
    for merge in ("gains", "union"):
        merged = evaluate(group, found, merge=merge)
        assert merged.exact
        assert found.lower - 1e-9 <= merged.aihtr.mean <= best + 1e-9


def test_an_exit_step_is_paid_where_others_are_left() -> None:
    check_bracket(Group([World(np.array([[0, 0.5], [0.5, 0]]), (1, 2), cost=0.2, t_max=0)] * 2))


@pytest.mark.parametrize("seed", range(5))
def test_brute_force_lies_in_the_bracket_with_both_policies_below(seed: int) -> None:
    check_bracket(Group([tiny(seed)] * 2))


@pytest.mark.parametrize("seed", later(range(5, 48)))
def test_brute_force_lies_in_the_bracket_of_many_more_worlds(seed: int) -> None:
    world = tiny(seed)
    check_bracket(Group([world, World.of(world, tiny(seed + 100).kernel) if seed % 2 else world]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_brute_force_lies_in_the_bracket_of_other_targets_and_longer_clocks(seed: int) -> None:
    world = tiny(seed, t_max=1)
    other = World.of(world, tiny(seed + 100).kernel)
    check_bracket(Group([world, world if seed % 2 else other]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("max_steps", [1, 2, 5])
def test_brute_force_of_truncated_episodes_is_below_the_bound(seed: int, max_steps: int) -> None:
    world = tiny(seed, max_steps=max_steps)
    group = Group([world, World.of(world, tiny(seed + 100).kernel) if seed % 2 else world])
    best, tables = (
        best_of_all(group),
        [solve(each.but(max_steps=None)).table for each in group.kinds],
    )
    assert best <= upper_bound(group) + 1e-9
    for merge in ("gains", "union"):
        rule = make_rule(group, tables, merge)
        exact, played = evaluate_group(rule), evaluate_group(rule, episodes=3_000)
        assert exact.exact
        assert exact.aihtr.mean <= best + 1e-9
        assert exact.totals[0, 5] == pytest.approx(group.expected_steps)
        assert exact.totals[0, 1] == pytest.approx(group.target_steps)
        assert played.totals[:, 5].max() <= max_steps
        assert played.aihtr.low is not None
        half = played.aihtr.mean - played.aihtr.low
        assert abs(played.aihtr.mean - exact.aihtr.mean) < 2 * half + 1e-9


@pytest.mark.parametrize("max_steps", [1, 2])
def test_the_paired_bound_counts_the_steps_allowed(max_steps: int) -> None:
    world = tiny(0, max_steps=max_steps, reward=1.0)
    found = group_bounds._Paired(world, world).value
    # A target earns 1 a step at most, where it stays; with three quarters of a chance each time.
    assert found.max() <= sum(0.75**step for step in range(1, max_steps + 1)) + 1e-12
    assert found.max() > sum(0.75**step for step in range(1, max_steps))


def test_targets_that_never_leave_are_followed_for_the_steps_allowed() -> None:
    world = World(np.full((4, 4), 0.25), 2, cost=0.1, max_steps=6)
    group = Group([world] * 2)
    assert group.expected_steps == 6
    assert evaluate(group, "none", merge="union").exact
    with pytest.raises(UserError, match="never"):
        evaluate(group, "none", merge="gains")


@pytest.mark.parametrize("seed", range(6))
def test_brute_force_is_below_the_bound_where_the_safe_action_is_cheap(seed: int) -> None:
    # What one target's clock forces locates the others, at no detection of theirs.
    rng = np.random.default_rng(seed)
    given: dict[str, Any] = {"detection": rng.uniform(0.2, 0.9), "cost": rng.uniform(0.05, 1.0)}
    given |= {"safe_cost": 0.1, "t_max": int(rng.integers(2)), "budget": [None, 1][seed % 2]}
    world = World(np.array([[0.9]]), (1, 1), **given)
    for count in (2, 3):
        group = Group([world] * count)
        assert best_of_all(group) <= upper_bound(group) + 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_brute_force_lies_above_the_policies_where_the_safe_action_misses(seed: int) -> None:
    # A clock may stand still for ever so long: beliefs go on all the while, so a target that does not move is taken.
    rng = np.random.default_rng(seed)
    given: dict[str, Any] = {"safe_detection": rng.uniform(0.3, 0.9), "cost": rng.uniform(0.1, 0.9)}
    given |= {
        "safe_cost": rng.uniform(0.5, 2.0),
        "t_max": seed % 2,
        "max_steps": [None, 6][seed // 2],
    }
    world = World(np.array([[0.8]]), (1, 1), detection=[1.0, 0.7][seed % 2], **given)
    for count in (2, 3):
        group = Group([world] * count)
        best = best_of_all(group)
        assert best <= upper_bound(group) + 1e-9
        table = solve(world.but(max_steps=None)).table
        for merge in ("gains", "union"):
            rule = make_rule(group, [table], merge)
            check_figures(rule, best, 4_000)


def test_one_target_whose_safe_action_misses_is_todays_world() -> None:
    world = tiny(2, t_max=1, safe_detection=np.array([0.5, 0.9, 0.7]), safe_cost=0.4)
    table = solve(world).table
    alone, group = evaluate(world, table), Group([world])
    # Not even where D is that of all sensors, and none of them misses.
    assert solve(Group([tiny(2)] * 2)).lower is not None
    assert solve(Group([tiny(2, safe_detection=0.5)] * 2)).lower is None
    for merge in ("gains", "union"):
        found = evaluate_group(make_rule(group, [table], merge), episodes=20_000)
        assert found.aihtr.low is not None
        assert abs(found.aihtr.mean - alone.aihtr) < 2 * (found.aihtr.mean - found.aihtr.low)


def test_one_target_is_todays_world() -> None:
    for seed in range(4):
        world = random_tiny_world(np.random.default_rng(seed))
        table = solve(world).table
        for merge in ("gains", "union"):
            found = evaluate(Group([world]), table, merge=merge)
            assert found.aihtr.mean == pytest.approx(evaluate(world, table).aihtr, abs=1e-9)
    assert isinstance(tm.make_world(size=4, targets=1), World)
    assert len(tm.make_world(size=4, targets=3)) == 3


@pytest.mark.parametrize("budget", [None, 1])
def test_simulation_agrees_with_the_joint_chain(budget: int | None) -> None:
    world = tiny(3, t_max=1, detection=np.array([0.9, 0.6, 1.0]), budget=budget)
    group = Group([world, World.of(world, tiny(4).kernel)])
    rule = make_rule(group, [solve(each).table for each in group.kinds])
    exact, played = evaluate_group(rule), evaluate_group(rule, episodes=4_000)
    assert exact.exact
    assert not played.exact
    for name in ("aihtr", "accuracy", "sensors_per_step", "safe_per_step"):
        found = getattr(played, name)
        assert found.low is not None
        half = (found.high - found.low) / 2
        assert abs(found.mean - getattr(exact, name).mean) < 2 * half, name
    assert exact.totals[0, 5] == pytest.approx(group.expected_steps)
    assert exact.totals[0, 1] == pytest.approx(group.target_steps)
    if budget is not None:
        assert exact.sensors_per_step.mean <= budget


@pytest.mark.parametrize("size", [2, 7])
def test_targets_that_leave_at_once_earn_nothing(size: int) -> None:
    world = World(np.zeros((size**2, size**2)), size, cost=0.1)
    found = evaluate(Group([world] * 2), "qmdp")
    assert (found.aihtr.mean, found.expected_length) == (0.0, 1.0)


def test_no_sensors_at_all_leave_every_second_step_to_the_safe_action() -> None:
    world = tiny(0)
    group = Group([world] * 2)
    rule = make_rule(group, [Policy.none(world)], "union")
    exact, played = evaluate_group(rule), evaluate_group(rule, episodes=1_000)
    assert played.sensors_per_step.mean == exact.sensors_per_step.mean == 0.0
    low, high = played.safe_per_step.low, played.safe_per_step.high
    assert low is not None
    assert high is not None
    assert low - 0.02 < exact.safe_per_step.mean < high + 0.02


def test_targets_are_the_same_for_every_policy_and_order_does_not_matter() -> None:
    world = tm.make_world(size=4, exit_probability=0.1)
    group = Group([world] * 3)
    played = [
        evaluate_group(make_rule(group, [table], merge), episodes=50)
        for table in (solve(world).table, Policy.all_on(world))
        for merge in ("gains", "union")
    ]
    for each in played:
        np.testing.assert_array_equal(each.totals[:, [1, 5]], played[0].totals[:, [1, 5]])
    one, other = tiny(1), World.of(tiny(1), tiny(2).kernel)
    ends = [evaluate(Group(each), "optimal").aihtr.mean for each in ((one, other), (other, one))]
    assert ends[0] == pytest.approx(ends[1])


def test_a_sensor_is_on_where_all_gains_together_exceed_its_price() -> None:
    # Two targets surely in cell 0, of which each is there next with probability 1/2: alone a gain of .5 · (1 - W).
    world = World(np.array([[0.5, 0.4], [0.4, 0.5]]), (1, 2), cost=0.7, t_max=0, safe_cost=1.4)
    group = Group([world] * 2)
    none = Policy.none(world)
    rule, apart = (make_rule(group, [none], merge) for merge in ("gains", "union"))
    seen = Clocks(np.zeros((1, 2), np.int64), np.zeros((1, 2), np.int64), np.ones((1, 2), bool))
    moved = Beliefs.of(group, seen.present, group.state_of(seen.located)).moved(group)
    value = evaluate(world, none).value
    lost = world.kernel @ (1.0 + value - 1.4)
    gain, any_left = 2 * world.kernel.toarray()[0] * (1 + value - lost), 1 - 0.1**2
    np.testing.assert_array_equal(rule.sets(seen, moved), np.flatnonzero(gain > 0.7 * any_left))
    assert not len(apart.sets(seen, moved))


@pytest.mark.slow
def test_bracket_of_two_targets_on_six_by_six_is_narrow() -> None:
    group = tm.make_world(size=6, support_size=5, exit_probability=0.02, cost=0.16, targets=2)
    found = solve(group)
    merged = evaluate(group, found, width=0.01)
    assert found.lower is not None
    assert merged.aihtr.high is not None
    assert found.lower <= merged.aihtr.high
    assert (found.upper - merged.aihtr.mean) / group.expected_steps < 0.02
    assert upper_bound(group) == found.upper


@pytest.mark.parametrize("modes", [1, 2])
def test_a_budget_that_forbids_no_set_is_none(modes: int) -> None:
    world = tiny(0)
    kernel = np.kron(world.kernel.toarray(), np.full((modes, modes), 1 / modes))
    free = Group([World.of(world, kernel, modes=modes)] * 2)
    same = free.but(budget=3)
    assert upper_bound(same) == upper_bound(free)
    tables = [PolicyTable.all_on(each) for each in same.kinds]
    assert evaluate_group(make_rule(same, tables, "union")).exact
    if modes == 1:
        assert upper_bound(free.but(budget=2)) <= upper_bound(free) < equal_shares(free)
        assert solve(same).lower == solve(free).lower


def test_united_sets_are_simulated_without_beliefs(monkeypatch: pytest.MonkeyPatch) -> None:
    rule = make_rule(Group([tiny(0)] * 2), [PolicyTable.all_on(tiny(0))], "union")
    monkeypatch.delattr(Beliefs, "moved")
    assert len(evaluate_group(rule, episodes=5).totals) == len(simulate(rule.group, rule, 5)) == 5
