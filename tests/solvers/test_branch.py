"""Branch and bound stopped anywhere: what it claims to have proved, it has."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from tests.solvers.worlds import all_plans, best_of_all, paper_world, random_tiny_world, searched
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, optimal
from trackmdp.solvers.certify import delayed
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.certify.joint import Joint
from trackmdp.solvers.certify.known import tables
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.optimal import payment
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.solution import SearchProgress
from trackmdp.world.model import World


def _to_the_end(tree: Tree) -> None:
    tree.run(lambda _: True)


def _tree() -> tuple[Tree, np.ndarray, np.ndarray]:
    """The renewals of the policy that the homotopy finds at Z = 5, c = 0.22, t_max = 2: some can be improved."""
    world = paper_world(5, 0.22, 2)
    value = evaluate(world, searched(world)).value
    problem = InnerProblem.of(Renewal(world, world.motion), value)
    known = tables(problem, slack=1e-9, run=_to_the_end)
    tree = Tree(problem, known, value, 1e-9)
    closed = Tree(problem, known, value, 1e-9)
    _to_the_end(closed)
    return tree, value, closed.best


def test_the_bound_holds_wherever_the_search_is_stopped_and_only_falls() -> None:
    tree, value, best = _tree()
    assert (best > value + 1e-6).any()
    last = np.full(len(value), np.inf)
    for most_nodes in (0, 10, 100, 1000, 10_000, 100_000):
        tree.run(lambda tree, most=most_nodes: tree.nodes < most)
        assert (tree.best <= best + 1e-9).all()
        assert (tree.upper() >= best - 1e-9).all()
        assert (tree.upper() <= last + 1e-12).all()
        last = tree.upper()
    assert tree.closed
    np.testing.assert_allclose(tree.best, best)
    assert (tree.upper() <= tree.best + 1e-9).all()


def test_improvements_are_the_chains_that_earn_what_is_claimed() -> None:
    """For each cell with a better chain: sense all possible cells but those left out, and the worth comes out."""
    tree, value, _ = _tree()
    tree.run(lambda _: True)
    world = paper_world(5, 0.22, 2)
    detected = world.reward + value
    better, left_out = tree.improvements()
    assert better.any()
    for x in np.flatnonzero(better):
        mass, worth = np.eye(100)[x], 0.0
        for left in left_out:
            mass = mass @ world.kernel
            sensed = (mass > 0) & ~left.has(np.full(100, x), np.arange(100))
            worth += float(mass[sensed] @ detected[sensed] - 0.22 * sensed.sum() * mass.sum())
            mass = np.where(sensed, 0.0, mass)
        worth += float((mass @ world.kernel) @ (detected - world.safe_cost))
        np.testing.assert_allclose(worth, tree.best[x], rtol=1e-12)


def test_a_search_cut_short_keeps_a_bracket_around_the_optimum() -> None:
    """Interrupted at every report, one later each time: the certified optimum lies in every bracket."""
    world = paper_world(5, 0.22, 2)
    best = optimal.solve(world).lower
    for reports in (1, 2, 3):
        left = iter(range(reports))

        def stop(_: SearchProgress, left: object = left) -> None:
            if next(left, None) is None:  # type: ignore[call-overload]
                raise KeyboardInterrupt

        solution = optimal.solve(world, on_progress=stop)
        assert solution.lower <= best + 1e-9
        assert solution.upper >= best - 1e-9


@pytest.mark.parametrize(("step", "calls"), [("_push", 0), ("_open", 0), ("_open", 1)])
def test_the_bound_holds_where_ctrl_c_comes_amid_an_expansion(
    step: str, calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was being expanded is still open: its plans may be the best ones."""
    tree, _, best = _tree()
    whole, called = getattr(Tree, step), itertools.count()

    def cut(*given: Any) -> None:
        if next(called) == calls:
            raise KeyboardInterrupt
        whole(*given)

    monkeypatch.setattr(Tree, step, cut)
    with pytest.raises(KeyboardInterrupt):
        _to_the_end(tree)
    assert not tree.closed
    assert (tree.upper() >= best - 1e-9).all()
    # Run again, it goes on from there.
    monkeypatch.undo()
    _to_the_end(tree)
    assert tree.closed
    assert tree.best == pytest.approx(best, abs=1e-7)


@pytest.mark.parametrize(
    "seed", [7, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (8, 9, 10))]
)
def test_every_bound_is_above_the_best_of_all_plans(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """80 worlds, the search stopped after 1, 30, 300 nodes or at its end: no policy exceeds what it claims.

    With the tables of positions revealed late, which close many of them at once, and by the tree alone. The slow ones
    make it 320.
    """
    rng, closed = np.random.default_rng(seed), {0: 0, delayed.WIDEST: 0}
    for nodes in np.tile([1, 30, 300, 100_000], 20):
        world = random_tiny_world(rng)
        best = best_of_all(world)
        scale = 1.0 + np.abs(best).max()
        assert (bounds.clocked(world) >= best - 1e-9 * scale).all()
        for widest in closed:
            monkeypatch.setattr(delayed, "WIDEST", widest)
            solution = optimal.solve(world, nodes=int(nodes), tolerance=1e-9)
            assert (solution.bound >= best - 1e-9 * scale).all()
            assert (solution.value <= best + 1e-9 * scale).all()
            if nodes == 100_000:
                assert solution.certified
                np.testing.assert_allclose(solution.value, best, atol=1e-7 * scale)
            closed[widest] += solution.certified and solution.nodes > 0
    assert closed[0] > 5
    assert closed[delayed.WIDEST] > 2


def test_what_is_paid_on_the_way_covers_what_any_plan_gains() -> None:
    """Over a policy that senses nothing, the tree stopped anywhere: every plan, with the mass it leaves undetected."""
    rng, less = np.random.default_rng(1), 0.0
    for nodes in np.tile([0, 4, 16, 64], 10):
        world = random_tiny_world(rng)
        value = evaluate(world, PolicyTable.none(world)).value
        problem = InnerProblem.of(Renewal(world, world.motion), value)
        known = tables(problem, slack=1e-9, run=_to_the_end)
        tree = Tree(problem, known, value, 1e-9)
        tree.run(lambda tree, most=nodes: tree.nodes < most)
        paid = payment(tree, value)
        less = max(less, float((np.maximum(tree.upper() - value, 0.0) - paid).max()))
        for x in range(world.num_cells):
            earned, located, waited = all_plans(world, x)
            gained = earned + located @ value - value[x]
            assert (paid[x] + waited @ paid >= gained - 1e-9 * (1.0 + np.abs(value).max())).all()
    assert less > 0.1


def test_what_is_paid_is_enough_by_its_own_rate_and_less_than_after_three_steps() -> None:
    """The proof needs e >= rate(e). From 0 every odd number of steps gives such an e, the more the less it is."""
    tree, value, _ = _tree()
    tree.run(lambda tree: tree.nodes < 3000)
    steps = [np.zeros_like(value)]
    for _ in range(4):
        steps.append(np.maximum(tree.rate(value, steps[-1]), 0.0))
    paid = payment(tree, value)
    assert (paid >= tree.rate(value, paid) - 1e-12).all()
    assert (
        steps[4] < tree.rate(value, steps[4]) - 1e-4
    ).any()  # an even number of steps is not enough
    assert (paid <= steps[3] + 1e-12).all()
    assert paid.mean() < 0.96 * steps[3].mean()


def test_joint_losses_hold_for_all_sets_of_undecided_cells() -> None:
    """A state of six cells, the first three decided: one more set for what is left, worth by definition, all ways."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        kernel = rng.random((6, 6)) ** 3 * (rng.random((6, 6)) < 0.6)
        kernel *= 0.95 / np.maximum(kernel.sum(axis=1, keepdims=True), 1e-9)
        world = World(kernel, (2, 3), cost=rng.uniform(0.0, 0.5, 6), t_max=1)
        detected, ends, known = (
            rng.normal(2.0, 1.0, 6),
            rng.normal(0.0, 1.0, 6),
            rng.normal(2.0, 1.0, 6),
        )
        cells, mass = np.arange(6)[None], rng.random((1, 6))
        joint = Joint(world, detected, [ends, known])
        after = joint.next(cells, mass, np.ones((1, 6), dtype=bool))
        assert after is not None

        def lost(left: np.ndarray) -> float:
            moved = (mass[0] * left) @ kernel  # noqa: B023
            sensed = moved * detected - world.cost * moved.sum()  # noqa: B023
            return float((mass[0] * left) @ known - np.maximum(sensed, moved * ends).sum())  # noqa: B023

        for decided in (2, 3, 6):
            left = np.arange(6) < decided - (decided == 3)
            own, added = joint.losses(after, 1, np.zeros(1, dtype=int), left[None], decided)
            np.testing.assert_allclose(own[0], lost(left))
            for others in itertools.product([False, True], repeat=6 - decided):
                chosen = left | np.array([False] * decided + list(others))
                assert lost(chosen) >= own[0] + added[0] @ np.array(others, dtype=float) - 1e-12
