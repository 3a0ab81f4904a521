"""Targets with a hidden heading: exact values of policies that remember, their bound, and solving for them."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from scipy import sparse

from tests.helpers import headings, random_kernel
from trackmdp.episodes.simulate import simulate
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.bounds import clocked
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.keyed import KeyedPairs, averaged, visits_of_keys
from trackmdp.solvers.keyed_search import cell_bound, mode_bound, solve_keys, told_bound
from trackmdp.world.env import TrackEnv
from trackmdp.world.model import World
from trackmdp.world.modes import HiddenWorld, heading_kernel

MORE = ("displacement", "displacement_gap", "two_displacements")


def random_policy(task: HiddenWorld, seed: int, share: float = 0.3) -> PolicyTable:
    on = np.random.default_rng(seed).random((task.num_keys * task.num_choices, task.num_cells)) < share
    return PolicyTable(task, sparse.csr_array(on))


def test_a_heading_by_hand() -> None:
    """From the middle of 3 x 3, going right: kept .8, turned .1 to either side; moved .9, else still."""
    kernel, modes = heading_kernel(3, keep=0.8, go=0.9, exit_probability=0.05)
    row = kernel[[4 * modes + 0]].toarray()[0]
    assert modes == 8
    assert row.sum() == pytest.approx(0.95)
    assert row[5 * 8 + 0] == pytest.approx(0.95 * 0.8 * 0.9)
    assert row[2 * 8 + 1] == pytest.approx(0.95 * 0.1 * 0.9)  # up and right
    assert row[8 * 8 + 7] == pytest.approx(0.95 * 0.1 * 0.9)  # down and right
    assert row[4 * 8 + 0] == pytest.approx(0.95 * 0.8 * 0.1)
    # At the right border, going right: turned back in its cell.
    assert kernel[5 * 8 + 0, 5 * 8 + 4] == pytest.approx(0.95 * 0.8 * 0.9)


@pytest.mark.parametrize("seed", [0, 1])
def test_one_mode_is_the_world_without_modes(seed: int) -> None:
    """With H = 1 and the cell as key, figures and bound are those of `World`."""
    kernel = random_kernel(np.random.default_rng(seed), 9, 0.1)
    world = World(kernel, 3, cost=0.2, t_max=1, detection=0.9)
    hidden = HiddenWorld(kernel, 3, modes=1, cost=0.2, t_max=1, detection=0.9)
    policy = random_policy(hidden, seed)
    ours, known = evaluate(hidden, policy), evaluate(world, PolicyTable(world, policy.sets))
    assert ours.value == pytest.approx(known.value)
    for name in ("accuracy", "sensors_per_step", "safe_per_episode", "expected_length"):
        assert getattr(ours, name) == pytest.approx(getattr(known, name))
    assert mode_bound(hidden)[:, 0] == pytest.approx(clocked(world), rel=1e-6)


def test_the_bound_of_long_episodes_is_found_at_once() -> None:
    """Rounds in which nothing but the exit brings it nearer would be as many as an episode has steps."""
    kernel = random_kernel(np.random.default_rng(0), 9, 1e-4)
    world, hidden = World(kernel, 3, cost=0.2, t_max=1), HiddenWorld(kernel, 3, modes=1, cost=0.2, t_max=1)
    assert mode_bound(hidden)[:, 0] == pytest.approx(clocked(world), rel=1e-9)
    assert (mode_bound(hidden)[:, 0] >= clocked(world) * (1 - 1e-12)).all()


@pytest.mark.parametrize("known", ["cell", *MORE, "mode"])
@pytest.mark.parametrize("detection", [1.0, 0.8])
def test_the_exact_value_is_that_of_the_game(known: str, detection: float) -> None:
    """4,000 simulated episodes agree within 3 standard errors, whatever the policy remembers or is told."""
    more: dict[str, Any] = {"revealed": 8} if known == "mode" else {"memory": known}
    world = headings(detection=detection, safe_cost=0.5, **more)
    policy = random_policy(world, 3)
    exact = evaluate(world, policy)
    played = simulate(world, Policy.from_table(policy), 4000, seed=5).figures()
    assert abs(played.aihtr.mean - exact.aihtr) < 3 * played.aihtr.standard_error
    assert abs(played.accuracy.mean - exact.accuracy) < 4 * played.accuracy.standard_error
    assert abs(played.expected_length.mean - exact.expected_length) < 3 * played.expected_length.standard_error


def to_and_fro(**more: Any) -> HiddenWorld:
    """Two cells and two modes: to and fro (the cell changes with .9), or lazy (it stays); the mode changes with .2."""
    move = {0: np.array([[0.1, 0.9], [0.9, 0.1]]), 1: np.array([[0.9, 0.1], [0.1, 0.9]])}
    kernel = np.zeros((4, 4))
    for x, u, y, v in itertools.product(range(2), repeat=4):
        kernel[2 * x + u, 2 * y + v] = 0.9 * move[v][x, y] * (0.8 if u == v else 0.2)
    return HiddenWorld(kernel, (1, 2), modes=2, cost=0.45, t_max=0, safe_cost=0.7, **more)


@pytest.mark.parametrize(
    ("more", "occurring"),
    [
        # On a line the displacements are -1, 0 and 1: of class 0 (start) and three more each cell has two that occur.
        pytest.param({"memory": "displacement", "clip": 1}, [0, 5, 4, 10, 15, 16], marks=pytest.mark.slow),
        ({"revealed": 2}, [0, 1, 2, 3]),
        ({"revealed": 2, "detection": 0.8}, [0, 1, 2, 3]),
    ],
)
def test_the_best_keyed_policy_of_a_tiny_world(more: dict[str, Any], occurring: list[int]) -> None:
    """Brute force over all plans of the keys that occur: 4 sets for each, t_max = 0."""
    world = to_and_fro(**more)
    found = solve_keys(world)
    best, pairs = -np.inf, KeyedPairs(world)
    sets = list(itertools.product([False, True], repeat=2))
    for choice in itertools.product(sets, repeat=len(occurring)):
        table = np.zeros((world.num_keys, 1, 2), dtype=bool)
        table[occurring, 0] = choice
        best = max(best, pairs.value(pairs.sets(PolicyTable.from_dense(world, table)))[2])
    assert found.lower == pytest.approx(best)
    assert best <= found.upper + 1e-12
    assert found.certified == ("revealed" in more)


@pytest.mark.parametrize("t_max", [0, 1])
def test_plans_that_can_be_improved_are_bounded_from_above(t_max: int) -> None:
    """The bound from V of a policy that senses nothing is above the optimum, and no better than the clocked one."""
    world = headings(t_max=t_max, revealed=8, safe_cost=0.5)
    pairs, best = KeyedPairs(world), solve_keys(world)
    value = pairs.value(pairs.sets(PolicyTable.none(world)))[0]
    bound = told_bound(pairs, value)
    assert bound is not None
    assert (bound >= pairs.value(pairs.sets(best.table))[0]).all()
    assert bound.mean() > best.lower + 0.1
    assert best.certified


def test_values_by_hand_where_the_mode_is_told() -> None:
    """t_max = 0, and .9 to be in the grid after a step."""
    world = to_and_fro(revealed=2)
    # All on, 2 sensors: V = .9 (1 - .9 + V) = .09 / .1.
    assert evaluate(world, PolicyTable.all_on(world)).value == pytest.approx([0.9, 0.9])
    # After mode 0 the other cell alone, after mode 1 its own: right with .8 · .9 + .2 · .1 = .74. By symmetry one V:
    # .9 (.74 - .45 + .74 V) + .9 · .26 · .9 (1 - .7 + V) whatever the mode.
    table = np.zeros((4, 1, 2), dtype=bool)
    table[[0, 1, 2, 3], 0, [1, 0, 0, 1]] = True
    hit, missed = 0.9 * 0.74, 0.9 * 0.26 * 0.9
    by_hand = (hit - 0.9 * 0.45 + missed * (1 - 0.7)) / (1 - hit - missed)
    assert evaluate(world, PolicyTable.from_dense(world, table)).value == pytest.approx([by_hand, by_hand])


@pytest.mark.parametrize(("keep", "cost", "loss"), [(0.9, 0.16, 0.052), (0.7, 0.16, 0.033), (0.9, 0.08, 0.014)])
def test_a_told_heading_leaves_little_to_lose(keep: float, cost: float, loss: float) -> None:
    """Per step to the bound that knows the heading at all times, on 6 x 6: at most what the prototype found."""
    kernel, modes = heading_kernel(6, keep=keep, go=0.9, exit_probability=0.01)
    found = solve_keys(world := HiddenWorld(kernel, 6, modes=modes, cost=cost, t_max=1, revealed=8))
    lost = (cell_bound(world).mean() - found.lower) / found.evaluation.expected_length
    assert 0.8 * loss < lost < loss + 0.001
    assert found.certified


def test_a_told_mode_is_worth_more_than_any_memory() -> None:
    told, remembered = solve_keys(headings(revealed=8)), solve_keys(headings(memory="displacement_gap"))
    assert remembered.lower < told.lower <= told.upper < remembered.upper
    # Whoever is told may still remember the displacement alone, and is worth what that is.
    again = evaluate(headings(revealed=8), remembered.table)
    assert again.aihtr == pytest.approx(remembered.lower)


def test_averaged_moves_are_those_that_are_seen() -> None:
    """Counted over 20,000 steps of the environment, cell to cell; the mode differs from cell to cell at the border."""
    world = headings(keep=0.9)
    cells = averaged(world)
    assert (cells.memory, cells.revealed, cells.kernel.shape) == ("cell", 1, (9, 9))
    env, seen = TrackEnv(world, 2000, seed=1), np.zeros((9, 10))
    state = env.reset()
    for _ in range(40):
        before = env.target.numpy()
        state["action"] = torch.ones(2000, 9, dtype=torch.bool)
        frame, state = env.step_and_maybe_reset(state)
        after = np.where(frame["next", "terminated"].squeeze(-1), 9, frame["next", "last_cell"])
        np.add.at(seen, (before, after), 1)
    total = seen.sum(axis=1, keepdims=True)
    expected = np.append(cells.kernel.toarray(), 1 - cells.kernel.sum(axis=1)[:, None], axis=1)
    error = np.sqrt(expected * (1 - expected) / total)
    assert (np.abs(seen / total - expected) < 5 * error + 1e-12).all()


def test_a_policy_with_a_memory_is_worth_the_same_where_memory_is_none() -> None:
    """In a world without modes a keyed policy whose plans are those of its cells earns what these do."""
    world = World(random_kernel(np.random.default_rng(4), 9, 0.1), 3, cost=0.2, t_max=1)
    plans = np.random.default_rng(5).random((9, 2, 9)) < 0.4
    task = world.remembering("displacement", clip=1)
    keyed = PolicyTable.from_dense(task, np.repeat(plans, task.keys.num_classes, axis=0))
    assert evaluate(world, keyed).value == pytest.approx(evaluate(world, plans).value)


def test_a_bound_is_above_what_solving_finds_and_memory_pays() -> None:
    cell, known = (solve_keys(headings(5, 0.9, cost=0.16, memory=memory)) for memory in ("cell", "displacement"))
    assert cell.upper == pytest.approx(known.upper)
    assert cell.lower < known.lower < known.upper
    # Forgetting the heading costs more than half of what there is to lose.
    assert known.upper - known.lower < 0.5 * (cell.upper - cell.lower)


def test_what_a_hidden_mode_does_not_go_with() -> None:
    with pytest.raises(UserError, match="safe action must not miss"):
        headings(safe_detection=0.9)
    with pytest.raises(UserError, match=r"expected grid\.window=null"):
        headings(window=1)
    with pytest.raises(UserError, match="72 rows"):
        headings(size=4).__class__(headings().kernel, 4, modes=8, cost=0.1, t_max=1)


@pytest.mark.parametrize("memory", ["cell", "displacement"])
def test_keys_are_visited_at_the_start_and_at_each_detection(memory: str) -> None:
    world = headings(3, t_max=1, memory=memory)
    policy = random_policy(world, 5)
    found, visits = evaluate(world, policy), visits_of_keys(world, policy)
    assert found.detections is not None
    assert visits.sum() == pytest.approx(1.0 + found.detections.mean())
    if memory == "displacement":  # nothing came before the start, and something before each detection
        assert visits[:: world.keys.num_classes] == pytest.approx(1 / 9)
