"""Every check of `verify` can fail: each fault in the list is seen by the check that is about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.solvers.worlds import paper_world
from trackmdp.episodes.belief import BeliefFilter
from trackmdp.paper import histories, theorems
from trackmdp.paper.theorems import Check, changed, corner, dearer
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import optimal
from trackmdp.solvers.solution import Solution
from trackmdp.world.model import Task, World

WORLDS = (corner(paper_world(5, 0.16, 1)), dearer(corner(paper_world(5, 0.22, 2))))
"""Four cells each. First sensors are worth their price at once; then misses happen and the clock runs out."""
SOLUTIONS = [optimal.solve(world, tolerance=1e-9) for world in WORLDS]
ORDER = ("FAILS", "open", "holds", "no case")

Fault = Callable[[pytest.MonkeyPatch], Callable[[Solution], Solution] | None]
Key = tuple[str, str]


def checked(solutions: Sequence[Solution] = SOLUTIONS) -> dict[Key, Check]:
    """Every claim by its name and the first words of its statement, where it comes out worst in both worlds."""
    found: dict[Key, Check] = {}
    for world, solution in zip(WORLDS, solutions, strict=True):
        for row in theorems.check_theorems(world, solution, 1e-9):
            key = row.name, " ".join(row.statement.split()[:3])
            if row.expected and (key not in found or ORDER.index(row.verdict) < ORDER.index(found[key].verdict)):
                found[key] = row
    return found


def in_the_solver(**changes: Any) -> Fault:
    """The solver of Theorem 2 solves another world than the POMDP's."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        real = optimal.solve
        more = {name: f if callable(f) else (lambda world, f=f: f) for name, f in changes.items()}
        patch.setattr(
            theorems.optimum,
            "solve",
            lambda world, **words: real(changed(world, **{name: f(world) for name, f in more.items()}), **words),
        )

    return apply


def in_the_histories(spoil: Callable[[histories.HistoryQ], histories.HistoryQ]) -> Fault:
    def apply(patch: pytest.MonkeyPatch) -> None:
        real = histories.solve_histories
        patch.setattr(theorems.histories, "solve_histories", lambda world: spoil(real(world)))

    return apply


def returns(module: str, name: str, spoil: Callable[[Any, World], Any]) -> Fault:
    """A function of the world that `theorems` calls gives something else."""

    def apply(patch: pytest.MonkeyPatch) -> None:
        real = getattr(getattr(theorems, module), name)
        patch.setattr(getattr(theorems, module), name, lambda world, **words: spoil(real(world, **words), world))

    return apply


def every(on: bool) -> Callable[[PolicyTable, Task], PolicyTable]:
    """Another policy in place of a policy: all sensors on, or none."""
    return lambda _, task: PolicyTable.from_dense(task, np.full((4, task.num_choices, 4), on))


def none_on(solution: Solution) -> Solution:
    return replace(solution, table=every(False)(solution.table, solution.table.task))


def located_too_low(solution: Solution) -> Solution:
    value = solution.value - np.array([5.0, 0.0, 0.0, 0.0])
    return replace(solution, evaluation=replace(solution.evaluation, value=value))


def known_too_low(patch: pytest.MonkeyPatch) -> None:
    real = theorems.tables
    patch.setattr(theorems, "tables", lambda *args, **words: [table - 1.0 for table in real(*args, **words)])


def forgetful(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(BeliefFilter, "miss", lambda self, predicted, action: predicted / predicted.sum(-1, keepdim=True))


def too_good(patch: pytest.MonkeyPatch) -> None:
    real = theorems.evaluate

    def evaluate(world: World, chains: Any) -> Any:
        found = real(world, chains)
        return replace(found, value=found.value + 100.0)

    patch.setattr(theorems, "evaluate", evaluate)


def constant(solved: histories.HistoryQ) -> histories.HistoryQ:
    return replace(solved, value=dict.fromkeys(solved.value, -12345.0))


def as_printed(solved: histories.HistoryQ) -> histories.HistoryQ:
    """What follows a miss whose cell is known is taken for what follows a detection there."""
    everything = len(solved.actions) - 1
    value = dict(solved.value)
    for x, history in solved.value:
        for j in range(4):
            if history and history[-1] == everything - (1 << (3 - j)):
                value[x, history] = solved.value[j, ()]
    return replace(solved, value=value)


def cost_on_exit(solved: histories.HistoryQ) -> histories.HistoryQ:
    return replace(solved, inside=dict.fromkeys(solved.inside, 1.0))


THEOREM_2, THEOREM_3 = ("Theorem 2", "V*_TMDP = V*_POMDP,"), ("Theorem 3, exact form", "the estimate from")
FAULTS: dict[str, tuple[Fault, Key]] = {
    "no sensor is ever on": (lambda _: none_on, ("Theorem 1", "p_j > c/r")),
    "no sensor is ever on, sharp": (lambda _: none_on, ("Theorem 1, sharp", "p_j > c")),
    "a cell is worth less when located": (lambda _: located_too_low, ("Lemma 1, first", "known at b")),
    "the search is told too low bounds": (known_too_low, ("Lemma 1, second", "with b sensed")),
    "D is not charged": (in_the_solver(safe_cost=0.0), THEOREM_2),
    "the clock is one step long": (in_the_solver(t_max=lambda world: world.t_max + 1), THEOREM_2),
    "the clock is one step short": (in_the_solver(t_max=lambda world: world.t_max - 1), THEOREM_2),
    "sensors cost a hundredth more": (in_the_solver(cost=lambda world: 1.01 * world.cost), THEOREM_2),
    "the value is a constant": (in_the_histories(constant), THEOREM_3),
    "W = V, as printed": (in_the_histories(as_printed), THEOREM_3),
    "sensors are charged on exit": (in_the_histories(cost_on_exit), THEOREM_3),
    "the belief forgets misses": (forgetful, THEOREM_3),
    "Q_MDP senses everything": (
        returns("qmdp", "solve", every(True)),
        ("Q_MDP", "threshold c/r: largest"),
    ),
    "Q_MDP senses nothing": (returns("qmdp", "solve", every(False)), ("Q_MDP", "threshold c p_in")),
    "the printed bound is the valid one": (
        returns("bounds", "paper", lambda bound, world: theorems.bounds.valid(world)),
        ("Q_MDP", "V*_QMDP as printed"),
    ),
    "Q_MDP is valued too high": (too_good, ("order", "Q_MDP <= optimum")),
    "the clocked bound is too low": (
        returns("bounds", "clocked", lambda bound, _: bound - 10.0),
        ("order", "optimum <= clocked"),
    ),
    "the valid bound is too low": (
        returns("bounds", "valid", lambda bound, _: bound - 10.0),
        ("order", "clocked bound <="),
    ),
}


def test_without_a_fault_every_claim_holds_and_has_a_case() -> None:
    assert {row.verdict for row in checked().values()} == {"holds"}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fault, key = FAULTS[name]
    spoil = fault(monkeypatch)
    assert checked([spoil(solution) for solution in SOLUTIONS] if spoil else SOLUTIONS)[key].verdict == "FAILS"


def test_every_claim_is_there_to_be_caught() -> None:
    assert {key for _, key in FAULTS.values()} == checked().keys()


def test_a_solver_that_ran_out_of_time_is_no_counter_example() -> None:
    cut = [replace(none_on(solution), certified=False) for solution in SOLUTIONS]
    row = checked(cut)["Theorem 1", "p_j > c/r"]
    assert not row.holds
    assert row.verdict == "open"
    assert row.passed


def test_a_search_that_is_cut_is_no_counter_example(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(theorems, "MOST_NODES", 0)
    row = checked()["Lemma 1, second", "with b sensed"]
    assert not row.holds
    assert row.verdict == "open"


def test_the_last_line_counts_claims_apart_from_forms_that_are_not_claimed() -> None:
    rows = [
        Check("a", "", 0.0, holds=True),
        Check("b", "", -np.inf, holds=True),
        Check("c", "", 3.0, holds=False, closed=False),
        Check("d", "", 3.0, holds=False, expected=False),
    ]
    assert theorems.summarize_checks(rows) == (
        "of 3 claims 1 hold, 1 have no case in this world, 1 are open, 0 FAIL; "
        "of 1 looser forms, not claimed, 1 do not hold"
    )
    assert [row.passed for row in rows] == [True] * 4
    assert not Check("e", "", 3.0, holds=False).passed
