"""Exchange: no cell's value falls, tiny worlds are solved, and so are worlds whose beliefs spread."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.solvers.worlds import best_of_all, searched, tiny_worlds
from trackmdp.arrays.types import BoolArray
from trackmdp.config.sensors import LARGEST_PRICE
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import exchange, optimal, search
from trackmdp.solvers.certify.inner import InnerProblem
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.plans import Plans
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found
from trackmdp.world.make import make_world
from trackmdp.world.model import World


def ascended(problem: InnerProblem, sets: list[BoolArray]) -> list[BoolArray]:
    """Sets of which no single one can be changed for the better."""
    return problem.plans().ascend(sets, sweeps=9)


@given(tiny_worlds(size=3, most_t_max=3, misses=True), st.integers(0, 2**32 - 1))
def test_no_cells_value_falls_from_whatever_sets_it_starts(world: World, seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = PolicyTable.from_dense(world, rng.random((9, world.num_choices, 9)) < 0.5)
    before, after = (
        evaluate(world, each).value for each in (start, exchange.improve(world, start))
    )
    assert (after >= before - 1e-9 * (1.0 + np.abs(before))).all()
    # Nor are the plans worth less after one round, whatever the mass that is left.
    renewal, mass = Renewal(world, world.motion), rng.random(9)
    problem = InnerProblem.of(renewal, before)
    plans, sets = problem.plans(mass), renewal.sets(start)
    worth = plans.worth_of(sets)
    found = plans.worth_of(exchange.exchange(plans, sets, np.ones(9, dtype=bool)))
    assert (found >= worth - 1e-9 * (1.0 + np.abs(worth))).all()


def test_one_round_gains_most_of_what_all_of_them_gain() -> None:
    world = make_world("drift", size=5, t_max=1, cost=0.3, persistence=0.5)
    start = searched(world)
    before, once, after = (
        evaluate(world, each).value
        for each in (
            start,
            exchange.improve(world, start, once=True),
            exchange.improve(world, start),
        )
    )
    assert (once >= before - 1e-9).all()
    assert 0.5 < (once.mean() - before.mean()) / (after.mean() - before.mean()) < 1.0 - 1e-6


def test_what_exchange_has_settled_is_not_searched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """But where some plans were left out, or its rounds ended, it goes on."""
    world = make_world("drift", size=5, t_max=1, cost=0.3, persistence=0.5)
    start = Found(renewal := Renewal(world, world.motion), search.clocked_sets(renewal))
    one = exchange.exchanged(start, rounds=1)
    left = exchange.exchanged(search.ascended(start), go_on=lambda: False)
    found = exchange.exchanged(start)
    assert (one.settled, left.settled, found.settled) == (False, False, True)
    monkeypatch.setattr(exchange, "exchange", lambda *_: pytest.fail("searched again"))
    assert exchange.exchanged(found) is found


@settings(
    max_examples=30, derandomize=True
)  # a search, not a proof: these 30 have to come out, others may not
@given(tiny_worlds(size=2, most_t_max=1))
def test_tiny_worlds_are_solved_as_brute_force_solves_them(world: World) -> None:
    best = best_of_all(world)
    found = evaluate(world, exchange.solve(world)).value
    np.testing.assert_allclose(found, best, rtol=0, atol=1e-8 * (1.0 + np.abs(best).max()))


def four_ways() -> InnerProblem:
    """From cell 0 to one of 1, 2, 3, 4, where the target stays but for an exit at .001; r = 1, c = .3, D = 5, V = 0."""
    kernel = 0.5 * np.eye(9)
    kernel[0, :5] = 0.0, 0.25, 0.25, 0.25, 0.25
    kernel[1:5, 1:5] = 0.999 * np.eye(4)
    world = World(kernel, 3, cost=0.3, safe_cost=5.0, t_max=1)
    detected = np.ones(9)
    renewal = Renewal(world, world.motion)
    return InnerProblem(renewal, detected, world.kernel @ (detected - 5.0), 2)


@pytest.mark.parametrize(("first", "then"), [((1, 2, 3, 4), ()), ((1, 2, 3), (4,))])
def test_one_or_two_cells_are_left_for_the_next_set(
    first: tuple[int, ...], then: tuple[int, ...]
) -> None:
    """Sensing k of the four cells and then the rest earns k/4 - .3 k + .999 (1 - k/4) (1 - .3 (4 - k)).

    That is -.2, .0248, .0998, .0249, -.2 for k = 0 ... 4: best is to halve the search, .5 - .6 + .999 · .5 · .4. With k
    = 4 or 3 no other set is better at either step, while the other step's stays as it is.
    """
    problem = four_ways()
    choices = problem.renewal.choices
    sets = [
        (np.isin(choice.sensors, cells) & (choice.rows == 0))[:, None]
        for choice, cells in zip(choices, (first, then), strict=True)
    ]
    stuck = [
        on[choice.rows == 0] for choice, on in zip(choices, ascended(problem, sets), strict=True)
    ]
    assert [on.sum() for on in stuck] == [len(first), len(then)]
    found = exchange.exchange(problem.plans(), sets, np.ones(9, dtype=bool))
    assert problem.plans().worth_of(found)[0] == pytest.approx(
        0.5 - 0.6 + 0.999 * 0.5 * 0.4, abs=1e-12
    )


@pytest.mark.parametrize(
    ("kernel", "cost", "options"),
    [
        ("drift", 0.22, {"persistence": 0.5}),
        ("drift", 0.3, {"persistence": 0.7}),
        ("random_walk", 0.4, {}),
    ],
)
def test_drifts_and_walks_reach_the_certified_optimum(
    kernel: str, cost: float, options: dict[str, float]
) -> None:
    world = make_world(kernel, size=10, cost=cost, t_max=1, **options)
    best = optimal.solve(world)
    assert best.certified
    assert evaluate(world, exchange.solve(world)).aihtr == pytest.approx(
        best.lower, abs=1e-6 * abs(best.lower)
    )
    assert evaluate(world, searched(world)).aihtr < best.lower - 1.0


def test_parts_and_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many located cells fit into a part, the sets are the same, and none leaves the window."""
    world = make_world("random_walk", size=6, cost=0.3, t_max=2, window=1)
    whole = exchange.solve(world).sets
    assert (
        evaluate(world, PolicyTable(world, whole)).aihtr
        > evaluate(world, searched(world)).aihtr + 1.0
    )
    monkeypatch.setattr(exchange, "MOST_NUMBERS", 1)
    alone = exchange.solve(world).sets
    assert whole is not None
    assert alone is not None
    assert (whole != alone).nnz == 0


def test_each_cell_takes_the_best_plan_of_all_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the cells have good plans in one start, half in another; each is poor elsewhere."""
    world = make_world("drift", size=4, persistence=0.5, cost=0.3, t_max=2, exit_probability=0.02)
    best, renewal = exchange.solve(world, 0), Renewal(world, world.motion)
    # The plans as they are.
    monkeypatch.setattr(exchange, "exchange", lambda _, sets, *__: sets)
    monkeypatch.setattr(Plans, "ascend", lambda _, sets, **__: sets)
    good, none = renewal.sets(best), renewal.sets(PolicyTable.none(world))
    halves = [
        [
            np.where(((choice.rows < 8) == first)[:, None], *on)
            for choice, *on in zip(renewal.choices, good, none, strict=True)
        ]
        for first in (True, False)
    ]
    found = exchange.best_of(Found(renewal, none), halves)
    assert (renewal.table(found.sets).sets != best.sets).nnz == 0
    kept = exchange.best_of(Found(renewal, good), [none, *halves])
    assert all((new == old).all() for new, old in zip(kept.sets, good, strict=True))


def test_other_starts_are_led_by_other_prices_and_end_higher() -> None:
    world = make_world("random_walk", size=6, cost=0.15, t_max=2, diagonal=True)
    renewal = Renewal(world, world.motion)
    first, again = (list(exchange.other_starts(renewal, 2)) for _ in range(2))
    assert all(
        (one == other).all()
        for each, same in zip(first, again, strict=True)
        for one, other in zip(each, same, strict=True)
    )
    assert any((one != other).any() for one, other in zip(*first, strict=True))
    values = [evaluate(world, exchange.solve(world, starts)).aihtr for starts in (0, 4)]
    assert values[1] > values[0] + 1e-3


def test_other_starts_have_prices_in_range() -> None:
    world = World(np.full((4, 4), 0.2), 2, cost=LARGEST_PRICE)
    found = list(exchange.other_starts(Renewal(world, world.motion), 4))
    assert not any(on.any() for sets in found for on in sets)


def test_without_a_free_choice_after_the_first_there_is_nothing_to_exchange() -> None:
    world = make_world("drift", size=5, cost=0.2, t_max=0)
    table = searched(world)
    assert (exchange.solve(world).sets != table.sets).nnz == 0


@pytest.mark.parametrize(
    ("options", "rounds"), [({}, 1), ({}, 3), ({"safe_detection": 0.7, "detection": 0.8}, 3)]
)
def test_of_new_plans_those_are_taken_that_gain_after_the_ones_before(
    options: Any, rounds: int
) -> None:
    """Where modes are hidden a better plan may lower the AIHTR: each key's gain, against whole evaluations."""
    world = make_world("heading", size=3, memory="displacement").but(**options)
    renewal = Renewal(world, world.motion)
    policy = search.follow_credit(Found(renewal, search.clocked_sets(renewal)), rounds, 1)
    plans = policy.plans()
    every = np.ones(len(renewal.plans), dtype=bool)
    sets = exchange.exchange(plans, policy.sets, every)
    order = np.random.default_rng(0).permutation(len(renewal.plans))
    order = order[search.rows_changed(plans.turns, policy.sets, sets)[order]]
    taken = search._gaining(policy, sets, order)
    assert 0 < len(taken) < len(order)
    now, rows = policy, np.zeros(len(renewal.plans), dtype=bool)
    for row in order:
        rows[row] = True
        tried = Found(renewal, search.mixed(plans.turns, rows, sets, policy.sets))
        assert (tried.aihtr > now.aihtr + policy.rounding) == (row in taken)
        rows[row] = row in taken
        now = tried if row in taken else now
