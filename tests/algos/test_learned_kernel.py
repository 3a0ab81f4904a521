"""The learned kernel as an algorithm: what it reads, what it plans, what it reports."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import sparse

from tests.helpers import algorithm, collect, hop_world, small_world
from trackmdp.algos.learned_kernel import observed_paths
from trackmdp.policies.policy import Policy
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.shrinkage import believed_world
from trackmdp.world.model import World


def learn(world: World, batches: int, *overrides: str) -> tuple[object, list[dict[str, float]]]:
    learner = algorithm("learned_kernel", world, "algo.rounds_at_end=50", "algo.samples=2", *overrides)
    learner.iterations = batches
    return learner, [learner.step(collect(world, learner.policy, 256, 20, seed=batch)) for batch in range(batches)]


def test_paths_are_read_from_what_the_tracker_saw() -> None:
    """Nothing is sensed: the target hops on unseen, is located by the safe action, or exits."""
    world = hop_world(t_max=1)
    learner = algorithm("learned_kernel", world)
    learner.policy = Policy.none(world)
    batch = collect(world, learner.policy, 64, 30)
    paths = observed_paths(batch, world)
    located = paths.end < 4
    assert set(paths.misses[located].tolist()) == {2}
    np.testing.assert_array_equal(paths.end[located], (paths.start[located] + 3) % 4)
    assert set(paths.misses[~located].tolist()) == {0, 1, 2}
    assert not paths.sensed.nnz
    ended = batch["next", "terminated"].sum() + (batch["next", "steps_since_detection"] == 0).sum()
    assert len(paths.end) <= int(ended)


@pytest.mark.parametrize("sensing", ["all", "chosen"])
def test_it_finds_the_optimum_of_a_small_world(sensing: str) -> None:
    world = small_world(3)
    warm_up = ["algo.warm_up=5000"] if sensing == "chosen" else []
    learner, _ = learn(world, 12, f"algo.sensing={sensing}", *warm_up)
    best = optimal.solve(world)
    found = evaluate(world, learner.actor)
    assert found.aihtr == pytest.approx(best.lower, abs=0.01)
    all_on = evaluate(world, np.ones((9, 2, 9), dtype=bool))
    assert found.aihtr > all_on.aihtr + 1


def test_chosen_sets_cost_less() -> None:
    world = small_world(3)
    _, fully = learn(world, 6)
    learner, chosen = learn(world, 6, "algo.sensing=chosen", "algo.warm_up=5000")
    assert fully[-1]["sensors_per_frame"] == pytest.approx(9.0)
    assert chosen[0]["sensors_per_frame"] == pytest.approx(9.0)
    assert chosen[-1]["sensors_per_frame"] < 5.0
    assert not (learner.policy.bits == 255).all()


@pytest.mark.slow
def test_its_uncertainty_shrinks_and_covers_the_truth() -> None:
    world = small_world(3)
    learner, rows = learn(world, 12, "algo.samples=50", "algo.plan_every=1")
    assert rows[-1]["believed_deviation"] < 0.6 * rows[0]["believed_deviation"]
    truth = evaluate(world, learner.actor).aihtr
    assert abs(rows[-1]["believed_aihtr"] - truth) < 4 * rows[-1]["believed_deviation"]
    visits = [row["least_visits"] for row in rows]
    assert visits == sorted(visits)
    assert visits[0] > 0


def test_a_resumed_learner_goes_on_as_the_first() -> None:
    world = small_world(3)
    words = ("algo.sensing=chosen", "algo.warm_up=0", "algo.samples=2")
    first, _ = learn(world, 3, *words)
    second = algorithm("learned_kernel", world, *words)
    second.iterations = 3
    second.load_state_dict(first.state_dict())
    batch = collect(world, first.policy, 64, 20, seed=7)
    assert first.step(batch) == second.step(batch)
    assert torch.equal(first.policy.bits, second.policy.bits)
    assert (first.actor.dense() == second.actor.dense()).all()


def test_the_state_is_plain_tensors_and_words(tmp_path) -> None:
    """It can be loaded without unpickling anything else."""
    learner, _ = learn(small_world(3), 2, "algo.sensing=chosen", "algo.warm_up=0")
    torch.save(learner.state_dict(), tmp_path / "state.pt")
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    again = algorithm("learned_kernel", small_world(3), "algo.sensing=chosen")
    again.load_state_dict(state)
    assert (again.actor.dense() == learner.actor.dense()).all()


def test_plans_within_the_window() -> None:
    """Where fewer sensors can be chosen than the target can reach, no set holds another."""
    world = small_world(5)
    narrow = World(world.kernel, 5, cost=0.05, t_max=1, window=1)
    learner, _ = learn(narrow, 2)
    row, cell = learner.actor.sets.nonzero()
    located = row // 2  # two sets per located cell
    assert len(row)
    assert np.abs(located // 5 - cell // 5).max() <= 1
    assert np.abs(located % 5 - cell % 5).max() <= 1


def test_plans_can_wait_for_the_last_batch() -> None:
    world = small_world(3)
    always, rows = learn(world, 4, "algo.samples=2")
    late, waited = learn(world, 4, "algo.plan_every=10", "algo.samples=2")
    assert np.array_equal(late.actor.dense(), always.actor.dense())  # type: ignore[attr-defined]
    assert np.isnan([row["believed_aihtr"] for row in waited[:3]]).all()
    assert waited[-1]["believed_aihtr"] == pytest.approx(rows[-1]["believed_aihtr"])
    assert [row["least_visits"] for row in waited] == [row["least_visits"] for row in rows]


def test_negligible_moves_are_planned_without_and_leave_the_exit_as_it_is() -> None:
    world = small_world(3)
    learner = algorithm("learned_kernel", world, "algo.negligible=0.3")
    kernel = sparse.lil_array((9, 10))
    kernel[0, [1, 3, 4, 9]] = 0.5, 0.3, 0.1, 0.1  # .1 goes, and the others share it 5 to 3
    kernel[1, [0, 2, 3, 4, 9]] = 0.2, 0.2, 0.2, 0.2, 0.2  # all would go, and all stay
    for row in range(2, 9):
        kernel[row, [row, 9]] = 0.5, 0.5
    believed = believed_world(world, sparse.csr_array(kernel), learner._least).kernel.toarray()
    np.testing.assert_allclose(believed[0, [1, 3, 4]], [0.5625, 0.3375, 0.0])
    np.testing.assert_allclose(believed[1, [0, 2, 3, 4]], 0.2)
    np.testing.assert_allclose(believed.sum(axis=1), [0.9, 0.8, *[0.5] * 7])


@pytest.mark.parametrize(("cells", "planned"), [(9, 6), (8, 1)])
def test_above_so_many_cells_it_plans_once(cells: int, planned: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trackmdp.algos.learned_kernel.DIRECT_CELLS", cells)
    _, rows = learn(small_world(3), 6, "algo.samples=2")
    believed = [row["believed_aihtr"] for row in rows]
    new = [after for before, after in zip([np.nan, *believed], believed, strict=False) if after != before]
    assert len([value for value in new if not np.isnan(value)]) == planned
