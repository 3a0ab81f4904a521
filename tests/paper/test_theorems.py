"""The paper's theorems as checks: they hold where they are claimed, and a wrong policy is found out."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from tests.solvers.worlds import paper_world, tiny_worlds
from trackmdp.arrays.types import BoolArray
from trackmdp.motion.kernels import random_walk
from trackmdp.paper import proofs, theorems, worlds
from trackmdp.paper.check import Check, summarize_checks
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, optimal, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.solution import Solution
from trackmdp.world.model import World


@pytest.fixture(autouse=True, scope="module")
def no_searches() -> Iterator[None]:
    """They take most of the time, and depend on no world: `test_mutations` has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proofs, "of_searches", lambda: iter(()))
        yield


def checks(world: World, solution: Solution | None = None) -> dict[tuple[str, str], Check]:
    solved = optimal.solve(world, tolerance=1e-9, nodes=4_000_000) if solution is None else solution
    return {(row.name, row.statement): row for row in theorems.check_theorems(world, solved, 1e-8)}


def named(rows: dict[tuple[str, str], Check], name: str) -> list[Check]:
    return [row for (own, _), row in rows.items() if own == name]


@settings(max_examples=12)
@given(tiny_worlds(most_t_max=2))
def test_every_claim_holds(world: World) -> None:
    for row in checks(world).values():
        assert row.passed, row
        assert not np.isnan(row.deviation)


def test_every_claim_holds_where_beliefs_spread() -> None:
    rows = checks(paper_world(5, 0.22, 2))
    assert all(row.passed for row in rows.values())
    (printed,) = named(rows, "Theorem 3, as printed")
    assert not printed.holds
    assert not printed.expected


def test_every_claim_holds_whatever_the_safe_action_costs() -> None:
    world = paper_world(4, 0.16, 1, 3).but(safe_cost=1e9)
    assert all(row.passed for row in checks(world).values())


@pytest.mark.parametrize("changes", [{"window": 0}, {"safe_detection": 0.5}])
def test_every_claim_holds_in_a_window_and_where_the_safe_action_misses(changes: Any) -> None:
    rows = checks(paper_world(4, 0.05, 1, 3).but(**changes))
    assert all(row.passed for row in rows.values())
    (sharp,) = named(rows, "Theorem 1, sharp")
    assert sharp.expected == ("window" not in changes)
    assert all(row.holds for row in named(rows, "Q_MDP"))


def test_where_a_miss_leaves_one_cell_at_most_nothing_is_said_of_the_others() -> None:
    rows = checks(World(0.95 * np.roll(np.eye(9), 1, axis=1), 3, cost=0.2))
    assert all(row.passed for row in rows.values())
    (second,) = named(rows, "Lemma 1, second")
    assert second.verdict == "no case"


def test_where_no_move_stays_in_the_corner_nothing_is_said_of_misses() -> None:
    rows = checks(World(0.9 * np.roll(np.eye(9), 2, axis=1) * (np.arange(9) != 3), 3, cost=0.2))
    assert all(row.passed for row in rows.values())
    (first,) = named(rows, "Lemma 1, first")
    assert first.verdict == "no case"


def _solution(world: World, chains: BoolArray) -> Solution:
    table = PolicyTable.from_dense(world, chains)
    return replace(optimal.solve(world), table=table, evaluation=evaluate(world, table))


def test_a_policy_without_the_track_property_is_found_out() -> None:
    """One sensor of the support switched off: p = 0.2113 there, so p r - c p_in = 0.2113 - 0.16 * 0.995."""
    world = paper_world(5, 0.16, 1)
    chains = optimal.solve(world).table.dense()
    cell = 44
    off = int(np.argmax(world.kernel.toarray()[cell]))
    chains[cell, 0, off] = False
    rows = checks(world, _solution(world, chains))
    (sharp,) = named(rows, "Theorem 1, sharp")
    assert not sharp.passed
    assert sharp.deviation >= world.kernel[cell, off] - 0.16 * 0.995 - 1e-12


def test_with_a_cheap_safe_action_being_overdue_is_worth_more_than_being_located() -> None:
    """Lemma 1 needs D >= the price of all sensors: at D = 0 and c > r, only the safe action earns anything."""
    kernel = np.full((4, 4), 0.2)
    world = World(kernel, 2, cost=np.full(4, 1.5), safe_cost=0.0, t_max=1)
    (row,) = named(checks(world), "Lemma 1, first")
    assert not row.holds
    assert not row.expected
    assert row.deviation > 0.1


def test_the_remark_on_worlds_where_qmdp_is_optimal() -> None:
    rows = {row.name: row for row in theorems.check_remarks(1e-9)}
    assert rows["remark, c = 0.14, Z = 4"].holds
    world = paper_world(4, 0.14, 1)
    np.testing.assert_array_equal(rules.qmdp(world).dense()[:, 0], world.kernel.toarray() > 0)
    assert optimal.solve(world).evaluation.accuracy == pytest.approx(1.0)


def test_the_printed_bound_is_exceeded() -> None:
    (row,) = [row for row in theorems.check_remarks(1e-9) if row.name == "the printed bound"]
    world = worlds.paper_world(worlds.paper_kernel(5, 5, "inside"), 0.16, 5)
    attained = evaluate(world, rules.clocked_policy(world)).aihtr
    assert attained > bounds.paper(world).mean() + 0.5
    assert attained <= bounds.valid(world).mean()
    assert not row.holds
    assert row.deviation == pytest.approx(attained - bounds.paper(world).mean())


def test_ties_do_not_look_like_failures() -> None:
    """A walk on nine cells, each as likely: from an inner cell p r = c p_in exactly, to sense or not is the same."""
    kernel = random_walk(4, stay=1 / 9, diagonal=True, exit_probability=0.1, border="renormalize")
    world = World(kernel, 4, cost=np.full(16, 1 / 9), safe_cost=16 / 9, t_max=1)
    assert all(row.passed for row in checks(world).values())


def test_the_last_line_counts_claims_apart_from_forms_that_are_not_claimed() -> None:
    rows = [
        Check("a", "", 0.0, holds=True),
        Check("b", "", -np.inf, holds=True),
        Check("c", "", 3.0, closed=False),
        Check("d", "", 3.0, expected=False),
    ]
    assert summarize_checks(rows) == (
        "of 3 claims 1 hold, 1 have no case in this world, 1 are open, 0 FAIL; "
        "of 1 looser forms, not claimed, 1 do not hold"
    )
    assert [row.passed for row in rows] == [True] * 4
    assert not Check("e", "", 3.0).passed


def test_no_case_where_there_are_cases_fails() -> None:
    assert Check("a", "", -np.inf).of_cases(0).judged(1e-9).verdict == "no case"
    assert Check("a", "", -np.inf).of_cases(3).judged(1e-9).verdict == "FAILS"
    assert Check("a", "", 0.0).of_cases(3).judged(1e-9).verdict == "holds"
