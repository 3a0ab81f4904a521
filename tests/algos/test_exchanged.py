"""Exchange at the end of hindsight: on what was counted, and on nothing else."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch

from tests.algos.hindsight import SHORT, assert_same, batches, learn, policy
from tests.helpers import algorithm, small_world
from trackmdp.algos import exchanged
from trackmdp.algos.exchanged import counted_world, exchanged_sets
from trackmdp.algos.segments import SensedPaths
from trackmdp.policies.policy import Policy
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.solvers.path_exchange import choose_plan, parted
from trackmdp.solvers.recorded import replay
from trackmdp.training.train import train
from trackmdp.world.make import make_world
from trackmdp.world.model import World


def spreading_world(size: int = 5, t_max: int = 1) -> World:
    """A drift that turns often, at a price at which sets are left out jointly."""
    return make_world("drift", size=size, persistence=0.5, cost=0.3, t_max=t_max, exit_probability=0.02)


def test_the_counted_world_is_the_share_of_each_move() -> None:
    """On 3 x 3 cells, 1,000 times: from 0 twice to 1, once to 3 and once out; cell 8 was never left."""
    start, end = (torch.tensor(cells * 1000) for cells in ([0, 0, 0, 0, 1, 3], [1, 1, 3, 9, 0, 9]))
    kernel = counted_world(small_world(3).task, start, end).kernel.toarray()
    everywhere = 2000.5 / 6001
    leave = (1000 + everywhere) / 4001  # the exit probability of all cells counts as one move
    np.testing.assert_allclose(kernel[0], [0, (1 - leave) * 2 / 3, 0, (1 - leave) / 3, 0, 0, 0, 0, 0], atol=1e-3)
    np.testing.assert_allclose(np.flatnonzero(kernel[1]), [0])
    np.testing.assert_allclose(kernel[[0, 8]].sum(axis=1), [1 - leave, 1 - everywhere], atol=1e-12)


def test_the_nets_are_what_they_are_without_it() -> None:
    world = spreading_world()
    data = batches(world)
    on, off = (learn(world, data, *SHORT, f"algo.exchange={on}") for on in (True, False))
    assert_same(on.state_dict(), off.state_dict())
    learned = Policy(world, off._learner.sets(world))
    assert np.array_equal(policy(off, world).dense(), learned.dense())
    counts = counted_world(world.task, *on._buffer.moves())
    values = [evaluate(counts, policy(each, world)).value for each in (off, on)]
    assert (values[1] >= values[0] - 1e-9).all()
    assert values[1].mean() > values[0].mean() + 1.0


@pytest.mark.parametrize(("collects", "markov"), [("all_on", True), ("mixed", True), ("all_on", False)])
def test_a_loaded_learner_has_the_exchanged_policy(collects: str, markov: bool) -> None:
    world = spreading_world() if markov else remembering_world()
    words = (*SHORT, f"algo.collect={collects}")
    learner = learn(world, batches(world), *words)
    file = io.BytesIO()
    torch.save(learner.state_dict(), file)
    file.seek(0)
    loaded = algorithm("hindsight", world, *words, "seed=5")
    loaded.load_state_dict(torch.load(file, weights_only=True))
    assert np.array_equal(policy(learner, world).dense(), policy(loaded, world).dense())
    assert not np.array_equal(policy(loaded, world).dense(), Policy(world, loaded._learner.sets(world)).dense())


def test_a_mixture_collects_with_the_exchanged_policy() -> None:
    world = spreading_world()
    learner = algorithm("hindsight", world, *SHORT, "algo.collect=mixed", "algo.explore.until=0.5", "algo.updates=500")
    for batch in batches(world)[:8]:
        learner.step(batch)
    learned = Policy(world, learner._learner.sets(world))
    expected = exchanged_sets(counted_world(world.task, *learner._buffer.moves()), learned.sets, anew=False)
    assert np.array_equal(policy(learner, world).dense(), Policy(world, expected).dense())
    assert (expected != learned.sets).nnz > 0
    assert learner.policy.bits.sum() == torch.as_tensor(np.packbits(Policy(world, expected).dense(), axis=-1)).sum()


def remembering_world() -> World:
    return World.of(spreading_world(), spreading_world().kernel, markov=False)


@pytest.mark.slow
def test_motion_with_memory_is_exchanged_on_whole_paths() -> None:
    """A quarter of the recordings, kept from the nets, say that the plan for the others is better than theirs."""
    world = remembering_world()
    data = batches(world, 64)
    off, on = (learn(world, data, *SHORT, "algo.buffer_size=20000", f"algo.exchange={on}") for on in (False, True))
    assert np.array_equal(policy(off, world).dense(), Policy(world, off._learner.sets(world)).dense())
    values = [evaluate(world, policy(each, world)).aihtr for each in (off, on)]
    assert values[1] > values[0] + 1.0
    tracks, learned = on._buffer.tracks(), Policy(world, on._learner.sets(world))
    kept, judging = parted(tracks, on._buffer.judge)
    chosen = choose_plan(world.task, kept, judge=judging, learned=learned, discount=0.8).policy
    assert (
        replay(world.task, judging, chosen).totals[:, 0].sum() > replay(world.task, judging, learned).totals[:, 0].sum()
    )


def test_learned_sets_stay_where_nothing_else_is_better_on_what_judges() -> None:
    """The optimum is learned; no plan for few paths is better on many others."""
    world = remembering_world()
    best = optimal.solve(world).policy
    few, many = (SensedPaths(25) for _ in range(2))
    for paths, batch in zip((few, many), (batches(world, 4), batches(world, 64, seed=1)), strict=True):
        for each in batch:
            paths.extend(each)
    found = choose_plan(world.task, few.tracks(), judge=many.tracks(), learned=best, discount=0.9).policy
    assert found.sets is not None
    assert best.sets is not None
    assert (found.sets != best.sets).nnz == 0


def test_plans_too_large_to_be_exchanged_are_left_as_learned(monkeypatch: pytest.MonkeyPatch) -> None:
    """25 cells, at most 5 successors: 25 · 5 · (1 + 5) = 750 moves of plans of two sets."""
    world = spreading_world()
    start = torch.arange(25)
    end = [torch.where((start + step >= 0) & (start + step < 25), start + step, 25) for step in (-5, -1, 1, 5, 6)]
    moves = start.repeat(5), torch.cat(end)
    sets = Policy.from_dense(world, np.zeros((25, 2, 25), dtype=bool)).sets
    for limit, left in ((750, False), (749, True)):
        monkeypatch.setattr(exchanged, "MOST_MOVES", limit)
        found = exchanged_sets(counted_world(world.task, *moves), sets)
        assert (found is sets) == left


def test_reports_that_are_missed_more_often_count_for_more() -> None:
    """From 0 to 1 twice, reported in half of all cases, and to 3 four times, always reported: as many of both."""
    world = small_world(3)
    task = World.of(world, world.kernel, detection=np.where(np.arange(9) == 1, 0.5, 1.0)).task
    start, end = torch.tensor([0] * 6), torch.tensor([1] * 2 + [3] * 4)
    kernel = counted_world(task, start, end).kernel.toarray()
    assert kernel[0, 1] == pytest.approx(kernel[0, 3])
    assert kernel[0, 1] > 0.4


@pytest.mark.slow
def test_a_drift_is_learned_to_its_certified_optimum() -> None:
    world = spreading_world()
    best = optimal.solve(world)
    assert best.certified
    regrets = []
    for on in (False, True):
        run = train(world, "hindsight", exchange=on, updates=200, optimal={"enabled": False}, seed=0)
        regrets.append(regret_per_step(best.upper, evaluate(world, run.policy)))
    assert regrets[1] < 0.001 < 0.01 < regrets[0]
