"""Several targets among sensors that cover several cells: against brute force, and the same in every part."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.episodes import groups
from tests.helpers import later
from tests.solvers.test_group import best_of_all, check_figures, tiny
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.errors import UserError
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.several.group_bounds import sensors_suffice, upper_bound
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.merging import Rule, make_rule
from trackmdp.world.group import Group
from trackmdp.world.model import World


def wide(seed: int, **more: Any) -> Group:
    """Two targets on three cells, among one to three sensors of random footprints; some miss, or do not exist."""
    rng = np.random.default_rng(seed)
    sensors = int(rng.integers(1, 4))
    covers = (rng.random((sensors, 3)) < 0.6).astype(float)
    covers[covers.sum(axis=1) == 0, 0] = 1
    if seed % 2:
        covers *= rng.choice([1.0, 0.5, 0.8], size=covers.shape)
    cost = rng.choice([0.1, 0.2, 0.35]) * (0.5 + rng.random(sensors))
    given: dict[str, Any] = {"coverage": covers, "t_max": int(rng.integers(2))}
    given["safe_cost"] = float(cost.sum() * rng.choice([0.5, 1, 2]))
    given |= {"budget": 1} if seed % 3 == 1 else {}
    given |= {"max_steps": 4} if seed % 4 == 2 else {}
    if seed % 5 == 4 and sensors > 1:
        cost[0] = np.nan
    world = tiny(seed, cost=cost, **(given | more))
    return Group([world, World.of(world, tiny(seed + 1000).kernel) if seed % 2 else world])


def rules(group: Group) -> list[Rule]:
    tables = [tm.solve(each.but(max_steps=None)).table for each in group.kinds]
    merges = ("gains", "union") if group.task.budget is None else ("gains",)
    return [make_rule(group, tables, merge) for merge in merges]


def check(seed: int) -> None:
    """Brute force is below the bound and above all policies; a single target's policies are its plan."""
    group = wide(seed)
    best = best_of_all(group)
    assert best <= upper_bound(group) + 1e-9
    if group.task.max_steps is None and (low := tm.solve(group).lower) is not None:
        assert low <= best + 1e-9
    for rule in rules(group):
        check_figures(rule, best, 3_000)
    if group.task.max_steps is None:
        for rule in rules(Group(group.worlds[:1])):
            alone = tm.evaluate(group.worlds[0], rule.tables[0]).aihtr
            assert evaluate_group(rule).aihtr.mean == pytest.approx(alone, abs=1e-9)


@pytest.mark.parametrize("seed", [2, 12])
def test_brute_force_lies_between_the_policies_and_the_bound(seed: int) -> None:
    check(seed)


@pytest.mark.parametrize("seed", later([*range(2), *range(3, 12), *range(13, 40)]))
def test_brute_force_lies_between_them_in_many_more_worlds(seed: int) -> None:
    check(seed)


def test_sensors_that_leave_a_cell_out_do_not_stand_for_the_safe_action() -> None:
    world = tiny(0, coverage=[[1, 1, 0], [0, 1, 1]], cost=0.1, safe_cost=0.2)
    assert sensors_suffice(world.task)
    assert not sensors_suffice(world.but(coverage=[[1, 1, 0], [1, 0, 0]]).task)
    assert not sensors_suffice(world.but(coverage=[[1, 1, 0], [0, 1, 0.9]]).task)


@pytest.mark.parametrize("seed", [3, 9])
def test_a_target_that_is_alone_has_the_sets_of_its_plan(seed: int) -> None:
    """Also where adding and dropping from none and from all find other sets."""
    rng = np.random.default_rng(seed)
    kernel = rng.random((8, 8)) ** 2
    kernel *= 0.8 / kernel.sum(axis=1, keepdims=True)
    covers = rng.random((10, 8)) < 0.35
    covers[~covers.any(axis=1), 0] = True
    world = World(kernel, (1, 8), coverage=covers, cost=rng.uniform(0.1, 0.3, 10), t_max=0)
    rule = make_rule(Group([world]), [tm.solve(world).table])
    group, start = rule.group, np.arange(8)[:, None]
    located = rule.start(start)
    sets = rule.sets(located, Beliefs.of(group, located.present, start).moved(group))
    assert np.array_equal(sets, rule.own_sets(located))


def test_a_sensor_that_covers_both_targets_is_on_where_neither_alone_pays_for_it() -> None:
    """A target stays with probability 1/2, and a miss costs nothing: gains of 1/2 each, at 1.2 while any is there."""
    world = World(np.diag([0.5, 0.5]), (1, 2), coverage=[[1, 1]], cost=1.2, t_max=0, safe_cost=1.0)
    alone = make_rule(Group([world]), [tm.solve(world).table])
    both = make_rule(Group([world] * 2), [tm.solve(world).table])
    for rule, count, expected in ((alone, 1, []), (both, 2, [0])):  # .5 at .6, and 1 at .9
        zero = np.zeros((1, count), np.int64)
        seen = Clocks(zero, zero, np.ones((1, count), bool))
        moved = Beliefs.of(rule.group, seen.present, rule.group.state_of(seen.located)).moved(
            rule.group
        )
        assert rule.sets(seen, moved).tolist() == expected


def test_environment_simulation_tracker_and_log_agree(tmp_path: Path) -> None:
    two: dict[str, Any] = {"coverage": [[0.8, 1, 0], [0, 0.5, 1]], "cost": 0.2, "safe_cost": 0.4}
    group = Group(
        [tiny(3, t_max=1, safe_detection=0.8, **two), tiny(4, t_max=1, safe_detection=0.8, **two)]
    )
    rule = rules(group)[0]
    episodes = tm.simulate(group, rule, 12)
    assert sum(int(each.located.sum()) for each in episodes) > 0
    groups.check_steps(group, episodes)
    for episode in episodes:
        assert len(list(groups.tracked(rule, episode))) == len(episode)
    with EpisodeReader(groups.write(tmp_path / "a.mcap", episodes.complete(), rule)) as reader:
        assert verify(reader).difference is None


@pytest.mark.slow
def test_networks_learn_of_all_targets_and_are_valued_alike(tmp_path: Path) -> None:
    world = tm.make_world("random_walk", size=3, exit_probability=0.2)
    rows = np.kron(np.eye(3), np.ones((1, 3)))  # a sensor for each row
    group = Group([world.but(coverage=rows, cost=0.3, safe_cost=0.9)] * 2)
    few: dict[str, Any] = {"total_frames": 512, "frames_per_batch": 256, "envs": 32, "hidden": 8}
    run = tm.train(group, "ppo", folder=tmp_path / "a", **few, **{"evaluation.width": 0.2})
    loaded = tm.load_run(tmp_path / "a")
    assert tm.evaluate(group, loaded, width=0.2).aihtr.mean == run.evaluation.aihtr


def test_targets_of_other_footprints_are_refused() -> None:
    one, other = (tiny(0, coverage=[row], cost=0.1) for row in ([1, 1, 1], [1, 1, 0]))
    with pytest.raises(UserError, match="target 1 has another grid, price or limit"):
        Group([one, other])
    with pytest.raises(UserError, match="target 1 has another grid, price or limit"):
        Group([tiny(0, cost=0.1), other])
