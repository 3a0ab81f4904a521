"""Several targets with hidden modes: the union of plans over keys, against brute force, and the same in every part."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trackmdp as tm
from tests.episodes import groups
from tests.helpers import later
from tests.solvers.test_group import best_of_all, check_figures
from trackmdp.app.cli import main
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.evaluate import evaluate, group_rule
from trackmdp.solvers.several import group_value
from trackmdp.solvers.several.group_bounds import upper_bound
from trackmdp.solvers.several.group_tracker import GroupTracker
from trackmdp.solvers.several.merging import make_rule
from trackmdp.solvers.several.simulation import group_steps
from trackmdp.world.group import Group
from trackmdp.world.model import World
from trackmdp.world.problem_file import problem_bytes, problem_digest, read_problem


def ring(turn: float, leave: float = 0.25, **more: Any) -> World:
    """Three cells in a ring: a target goes on to the next one, or turns and goes to the other; moves tell its mode."""
    kernel = np.zeros((6, 6))
    for cell in range(3):
        for mode, step in enumerate((1, 2)):
            for after, chance in ((mode, 1 - turn), (1 - mode, turn)):
                to = (cell + (step if after == mode else 3 - step)) % 3
                kernel[cell * 2 + mode, to * 2 + after] = chance * (1 - leave)
    return World(kernel, (1, 3), modes=2, **{"cost": 0.3, "safe_cost": 1.0, "t_max": 1} | more)


def random_table(world: World, seed: int) -> PolicyTable:
    shape = world.num_keys, world.num_choices, world.total_sensors
    return PolicyTable.from_dense(world, np.random.default_rng(seed).random(shape) < 0.5)


@pytest.mark.parametrize(
    "more",
    [
        {"detection": 0.8, "t_max": 0},
        *later([{}, {"safe_cost": 0.4, "max_steps": 5, "t_max": 0}]),
    ],
)
def test_brute_force_lies_between_the_policies_and_the_bound(more: dict[str, Any]) -> None:
    """Where targets never turn there are few beliefs: at the first detection after the start the mode is known."""
    world = ring(0.0, **more)
    group = Group([world, World.of(world, ring(0.0, 0.5).kernel, modes=2, revealed=1)])
    best = best_of_all(group)
    assert best <= upper_bound(group) + 1e-9
    for seed in range(3):
        rule = group_rule(group, random_table(world, seed))
        check_figures(rule, best, 3_000)


@pytest.mark.parametrize(
    ("turn", "memory", "reveals"),
    [
        (0.0, "cell", False),
        pytest.param(0.2, "cell", False, marks=pytest.mark.slow),
        (0.2, "displacement", False),
        (0.2, "cell", True),
        (0.2, "displacement", True),
    ],
)
def test_one_target_is_todays_world(turn: float, memory: str, reveals: bool) -> None:
    world = ring(turn, memory=memory, clip=1, detection=0.8, reveals=reveals)
    for seed in range(4):
        table = random_table(world, seed)
        alone = evaluate(world, table).aihtr
        found = evaluate(Group([world]), table, merge="union", width=0.02)
        if turn == 0:
            assert found.aihtr.mean == pytest.approx(alone, abs=1e-9)
        else:
            assert found.aihtr.low is not None
            half = found.aihtr.mean - found.aihtr.low
            assert abs(found.aihtr.mean - alone) < 2 * half


def test_the_best_policy_of_revealed_modes_is_that_of_states(tmp_path: Path) -> None:
    """The chain over joint states finds a single target's optimum; two targets' union is below theirs."""
    world = ring(0.2, leave=0.4, cost=0.4, safe_cost=1.3, t_max=0, reveals=True)
    optimum = tm.solve(world)
    assert optimum.certified
    assert best_of_all(Group([world])) == pytest.approx(optimum.upper, rel=1e-6)
    none = evaluate(Group([world]), tm.Policy.none(world.remembering()))
    assert none.exact
    assert none.aihtr.mean == pytest.approx(evaluate(world, "none").aihtr, abs=1e-9)
    group = Group([world, World.of(world, ring(0.5, 0.5).kernel, modes=2, revealed=2)])
    solved, best = tm.solve(group), best_of_all(group)
    assert solved.policy.name == "gains"
    assert solved.lower is not None
    assert solved.lower <= best <= solved.upper + 1e-9
    for merge in ("gains", "union"):
        played = evaluate(group, solved, width=0.01, merge=merge).aihtr
        assert played.low is not None
        assert played.high is not None
        assert played.low < best
        assert solved.lower < played.high
    limited = group.but(budget=1)
    played, best = evaluate(limited, tm.solve(limited), width=0.01).aihtr, best_of_all(limited)
    assert played.low is not None
    assert best - 0.2 < played.low < best
    episodes = tm.simulate(group, solved.policy, 5).complete()
    with EpisodeReader(groups.write(tmp_path / "a.mcap", episodes, solved.policy)) as reader:
        assert verify(reader).difference is None


def test_plans_of_shown_modes_are_merged_alike_whatever_policies_may_remember() -> None:
    """Where a detection tells all, the optimum reads nothing else, also in a task that lets it remember more."""
    worlds = [ring(0.1, reveals=True, memory=memory) for memory in ("cell", "displacement")]
    found = []
    for world in worlds:
        group = Group([world, world])
        rule = group_rule(group, tm.solve(group).policy)
        assert rule.name == "gains"
        found.append(evaluate(group, rule, width=0.05).aihtr.mean)
    assert found[0] == found[1]


@pytest.mark.parametrize("memory", ["cell", "displacement"])
def test_a_tracker_that_is_shown_modes_does_as_the_simulation(memory: str) -> None:
    """Plans are those of the states shown, and a detection leaves no doubt of the mode."""
    world = ring(0.2, 0.02, memory=memory, clip=1, detection=0.7, reveals=True)
    group = Group([world, World.of(world, ring(0.5, 0.02).kernel, modes=2, revealed=2)])
    rule, rng = group_rule(group, random_table(world, 1)), np.random.default_rng(0)
    assert rule.name == ("gains" if memory == "cell" else "union")
    targets, chosen = group_value._Drawn(group, 1, rng), set()
    place, mode = group.cell_of(targets.state)[0].tolist(), (targets.state[0] % 2).tolist()
    tracker = GroupTracker(rule, place, modes=mode)
    for step in group_steps(rule, targets, lambda *_: rng.random((1, 2)), predicted=True):
        tracker = GroupTracker.restore(rule, json.loads(json.dumps(tracker.state())))
        assert tracker.safe == step.late[0]
        assert tracker.safe or tracker.sensors() == step.on.tolist()
        seen, mode = step.seen[0], targets.state[0] % 2
        shown = [
            [int(each) if hit else None for each, hit in zip(values, seen, strict=True)]
            for values in (step.cell[0], mode)
        ]
        tracker.sensors()
        tracker.report(shown[0], gone=np.flatnonzero(~step.inside[0]).tolist(), modes=shown[1])
        np.testing.assert_allclose(tracker.belief()[seen], np.eye(3)[step.cell[0, seen]])
        np.testing.assert_allclose(
            [tracker._masses()[k, targets.state[0, k] % 6] for k in np.flatnonzero(seen)], 1.0
        )
        chosen.update(mode[seen].tolist())
    assert chosen == {0, 1}
    for modes, message in (
        (None, "mode=None, expected one of 0 ... 1"),
        ([0, 2], "mode=2: expected"),
    ):
        with pytest.raises(UserError, match=message):
            GroupTracker(rule, [0, 1], modes=modes)
    with pytest.raises(UserError, match="mode=1, expected none"):
        GroupTracker(group_rule(Group([ring(0.1)]), "none"), [0], modes=[1])


def test_environment_simulation_tracker_and_log_agree(tmp_path: Path) -> None:
    """And beliefs are those of a filter over states, written out."""
    world = ring(0.2, 0.1, memory="displacement", clip=1, detection=0.7, safe_detection=0.8)
    group = Group([world, World.of(world, ring(0.5, 0.2).kernel, modes=2, revealed=1)])
    rule = group_rule(group, tm.Policy.from_table(random_table(world, 1)))
    assert rule.name == "union"
    kernels = [each.kernel.toarray() for each in group.worlds]
    episodes, found = tm.simulate(group, rule, 15), 0
    groups.check_steps(group, episodes)
    for episode in episodes:
        beliefs = [np.repeat(np.eye(3)[cell], 2) / 2 for cell in episode.start]
        forced = episode.forced(world.t_max)
        for t, tracker in enumerate(groups.tracked(rule, episode)):
            chance = np.where(forced[t], 0.8, 0.7 * episode.action[t]).repeat(2)
            for k, cell in enumerate(episode.target[t].tolist()):
                hit = bool(episode.located[t, k])
                likely = np.repeat(np.eye(3)[cell], 2) if hit else 1 - chance
                after = beliefs[k] @ kernels[k] * (0 * chance if cell == 3 else likely)
                beliefs[k] = after / max(after.sum(), 1e-300)
                found += hit
            expected = np.stack(beliefs).reshape(2, 3, 2).sum(axis=2)
            np.testing.assert_allclose(tracker.belief(), expected, atol=1e-12)
    assert found > 50
    with EpisodeReader(groups.write(tmp_path / "a.mcap", episodes.complete(), rule)) as reader:
        assert verify(reader).difference is None


def test_a_target_that_comes_where_no_move_leads_is_followed_on() -> None:
    """It stays where every target moves: nothing is known of its mode then, and the next move tells it again."""
    world = ring(0.0, t_max=2)
    tracker = GroupTracker(group_rule(Group([world]), random_table(world, 0), "union"), [0])
    for cell, belief in ((1, [0, 1, 0]), (1, [0, 1, 0]), (2, [0, 0, 1])):
        tracker._on = [0, 1, 2]
        tracker.report([cell])
        np.testing.assert_allclose(tracker.belief(), [belief])
    tracker._on = []
    tracker.report([None])
    np.testing.assert_allclose(tracker.belief(), [[1, 0, 0]])


def test_plans_of_different_memories_are_refused() -> None:
    worlds = [ring(0.1, memory="displacement", clip=clip) for clip in (1, 2)]
    group = Group([worlds[0], World.of(worlds[0], worlds[1].kernel, modes=2, revealed=1)])
    tables = [random_table(world, 0) for world in worlds]
    with pytest.raises(UserError, match="plans of different memories, expected the same"):
        make_rule(group, tables)


def test_a_group_is_the_same_from_its_file(tmp_path: Path) -> None:
    world = ring(0.2, memory="displacement")
    group = Group([world, World.of(world, ring(0.5).kernel, modes=2, revealed=1), world])
    (tmp_path / "a.npz").write_bytes(problem_bytes(group))
    again = read_problem(tmp_path / "a.npz")
    assert isinstance(again, Group)
    assert problem_digest(again) == problem_digest(group)
    assert (again.modes, again.targets) == (2, (0, 1, 0))


@pytest.mark.slow
@pytest.mark.parametrize("shown", [False, True])
def test_plans_are_learned_and_solved_for_and_united(tmp_path: Path, shown: bool) -> None:
    """Where a detection reveals the mode they are merged by gains, and set beside the merged optimum."""
    own = {"reveals": True} if shown else {"memory": "displacement", "clip": 1}
    group, name = Group([ring(0.1, **own)] * 2), "gains" if shown else "union"
    solved = tm.solve(group)
    assert solved.policy.name == name
    assert (solved.lower is None) == (not shown)
    assert evaluate(group, solved, width=0.1).aihtr.mean < solved.upper
    few: dict[str, Any] = {"total_frames": 2000, "frames_per_batch": 1000}
    run = tm.train(group, folder=tmp_path, **few, **{"evaluation.width": 0.1})
    again = evaluate(group, tm.load_run(tmp_path), width=0.1)
    assert run.summary["several"]["merge"] == name
    assert (run.summary["several"]["merged_optimum"] is None) == (not shown)
    assert run.summary["several"]["figures"]["aihtr"]["mean"] == again.aihtr.mean


@pytest.mark.slow
def test_runs_of_different_memories_are_compared_in_the_same_problem(tmp_path: Path) -> None:
    few: dict[str, Any] = {"total_frames": 1000, "frames_per_batch": 1000, "evaluation.width": 0.2}
    for memory in ("cell", "displacement"):
        group = Group([ring(0.1, memory=memory, clip=1)] * 2)
        tm.train(group, folder=tmp_path / memory, **few)
    words = [f"run={tmp_path / memory}" for memory in ("cell", "displacement")]
    assert main(["compare", *words, f"hydra.run.dir={tmp_path / 'c'}", "quiet=true"]) == 0
    written = json.loads((tmp_path / "c" / "comparison.json").read_text(encoding="utf-8"))
    assert [each["name"] for each in written["policies"]] == ["cell", "displacement"]


def test_what_modes_do_not_go_with_is_refused() -> None:
    with pytest.raises(UserError, match="budget=1 and hidden modes, expected none"):
        Group([ring(0.1, budget=1)] * 2)
    with pytest.raises(UserError, match="TrackEnv: a Group whose modes a detection reveals"):
        tm.TrackEnv(Group([ring(0.1, reveals=True)] * 2))
    with pytest.raises(
        UserError, match=r"targets\.merge=gains: expected union, or plans of cell and"
    ):
        evaluate(Group([ring(0.1)] * 2), "none", merge="gains")
    with pytest.raises(UserError, match=r"task\.memory=displacement: expected cell"):
        tm.train(Group([ring(0.1, memory="displacement")] * 2), "ppo")
