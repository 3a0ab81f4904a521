from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import sparse

from tests.algos.hindsight import (
    SHORT,
    assert_it_learns,
    assert_same,
    batches,
    learn,
    policy,
)
from tests.helpers import algorithm, later, small_world, train_config
from trackmdp.algos.estimates.path_gains import KeyPlans, Paths, along
from trackmdp.algos.estimates.path_plans import choose_plan, parted
from trackmdp.algos.hindsight import _within, budget
from trackmdp.errors import UserError
from trackmdp.motion.kernels import random_walk
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task
from trackmdp.solvers import bounds
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.world.make import make_world
from trackmdp.world.model import World


@pytest.mark.parametrize("t_max", [2, *later([0])])
def test_reaches_the_optimum_of_a_small_world(t_max: int) -> None:
    assert_it_learns("hindsight", (), t_max)


def test_the_same_seed_learns_the_same_and_another_does_not() -> None:
    world = small_world()
    data = batches(world)
    first, second, third = (
        learn(world, data, *SHORT, f"seed={seed}").state_dict() for seed in (0, 0, 1)
    )
    assert_same(first, second)
    with pytest.raises(AssertionError):
        assert_same(first, third)


def test_collects_with_every_sensor_on() -> None:
    world = small_world()
    frames = batches(world, 1)[0]
    assert bool(frames["action"].all())


def test_learns_once_the_frames_are_in() -> None:
    world = small_world()
    learner = algorithm("hindsight", world, *SHORT)
    figures = [learner.step(batch) for batch in batches(world)]
    assert [row["updates"] for row in figures] == [0] * 16
    assert learner.iterations == 16 + 3
    assert [learner.step(None)["updates"] for _ in range(3)] == [10, 20, 30]


@pytest.mark.parametrize(
    ("words", "t_max", "expected"), [((), 2, 500), ((), 4, 800), (("algo.updates=7",), 2, 7)]
)
def test_updates_grow_with_the_rows(words: tuple[str, ...], t_max: int, expected: int) -> None:
    cfg = train_config("algo=hindsight", *words).algo
    assert budget(Task(10, cost=0.1, t_max=t_max), cfg)[0] == expected


def test_keys_of_three_detections_take_fewer_updates_and_smaller_nets() -> None:
    cfg, task = train_config("algo=hindsight").algo, Task(3, cost=0.1, t_max=1, markov=False)
    assert budget(replace(task, memory="displacement_gap"), cfg) == (400, 256)
    assert budget(replace(task, memory="two_displacements"), cfg) == (400, 64)


def test_credit_per_sensor_takes_more_updates_but_with_a_memory() -> None:
    cfg, task = train_config("algo=a2c_per_sensor").algo, Task(10, cost=0.1, t_max=4, markov=False)
    found = [budget(replace(task, memory=memory), cfg)[0] for memory in ("cell", "displacement")]
    assert found == [1280, 400]


def test_a_target_that_goes_farther_than_the_nets_see_is_gone() -> None:
    """On a 3x3 grid: 0 -> 1 -> 4 are steps of one, 4 -> 0 is diagonal, 1 -> 7 and 0 -> 2 are two; 9 is outside."""
    paths = torch.tensor([[0, 1, 4, 0], [1, 7, 4, 1], [0, 1, 9, 9], [4, 3, 0, 2]]).T
    expected = [[0, 1, 4, 0], [1, 9, 9, 9], [0, 1, 9, 9], [4, 3, 0, 9]]
    assert _within(paths, 1, Task(3, cost=0.1, t_max=1)).T.tolist() == expected
    assert torch.equal(_within(paths, 2, Task(3, cost=0.1, t_max=1)), paths)


def test_frames_without_a_move_are_refused_in_one_line() -> None:
    world = small_world()
    learner = algorithm("hindsight", world, *SHORT)
    for batch in batches(world):
        batch["action"].zero_()
        learner.step(batch)
    with pytest.raises(UserError, match=r"^algo\.total_frames: .*$"):
        learner.step(None)


def test_where_the_target_moves_alike_few_frames_are_enough() -> None:
    """144 cells and 12,000 frames: too few for each cell alone, plenty for all of them together."""
    kernel = random_walk(12, stay=0.2, diagonal=False, exit_probability=0.02, border="renormalize")
    alone = World(kernel, 12, cost=np.full(144, 0.16), safe_cost=144 * 0.16, t_max=1)
    data = batches(alone, 47)
    upper = float(bounds.clocked(alone).mean())
    words = (
        "algo.updates=150",
        "algo.updates_per_iteration=150",
        "algo.batch_size=4096",
        "algo.hidden=32",
    )
    learners = [
        learn(alone, data, "algo.total_frames=12032", f"algo.share_cells={shared}", *words)
        for shared in ("none", "all")
    ]
    regrets = [
        regret_per_step(upper, evaluate(alone, policy(learner, alone))) for learner in learners
    ]
    assert regrets[1] < 0.5 * regrets[0]
    assert regrets[1] < 0.02


def test_joint_changes_begin_from_both_actors() -> None:
    """On the paths that judge the clocked actor's sets, changed, earn more here than those of the actor."""
    world = make_world("heading", size=4, memory="displacement")
    words = ("algo.updates=60", "algo.updates_per_iteration=60", "algo.batch_size=2048")
    learner = learn(world, batches(world), *words, "algo.hidden=32")
    found, buffer = PolicyTable(world, learner.actor.sets), learner._buffer
    _, judge = parted(buffer.tracks(), buffer.judge)
    judged = Paths(world, judge, 0.95)

    def earned(table: PolicyTable) -> float:
        return along(judged, KeyPlans.of_table(table, judged.keys)).reward

    def changed(sets: sparse.csr_array) -> PolicyTable:
        start = [lambda *_: PolicyTable(world, sets)]
        options = {"priors": (), "others": start, "discount": 0.95, "seed": buffer.judge}
        return choose_plan(world, buffer.tracks(), **options).policy

    nets = learner._learner
    alone, clocked = (
        earned(changed(sets)) for sets in (nets.sets(world), nets.clocked_sets(world))
    )
    assert alone < clocked == pytest.approx(earned(found), rel=1e-9)


def test_tables_learn_as_nets_do() -> None:
    assert_it_learns("hindsight", ("algo.hidden=0",), 1)
