"""Every check of `verify` can fail: each fault is noticed by the check that is about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import cache
from itertools import chain
from typing import Any

import pytest

from tests.helpers import headings, later
from tests.solvers.worlds import paper_world
from trackmdp.paper import histories, proofs, theorems
from trackmdp.paper.check import Check
from trackmdp.paper.corner import corner, dearer
from trackmdp.policies.belief import BeliefFilter
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import bounds, estimator, hidden, optimal, pomdp, rules
from trackmdp.solvers.certify import known
from trackmdp.solvers.certify.branch import Tree
from trackmdp.solvers.certify.delayed import Delayed
from trackmdp.solvers.certify.joint import Joint

WORLDS = (corner(paper_world(5, 0.16, 1)), dearer(corner(paper_world(5, 0.22, 2))))
"""Four cells each. First sensors are worth their price at once; then misses happen and the clock runs out."""
HIDDEN = headings(2)
ORDER = ("FAILS", "open", "holds", "no case")
Patch = pytest.MonkeyPatch
Fault = Callable[[Patch], Any]


@cache
def solutions() -> list[Any]:
    return [*(optimal.solve(world, tolerance=1e-9) for world in WORLDS), hidden.solve(HIDDEN)]


def of_cells(solved: list[Any]) -> Iterator[Check]:
    for world, solution in zip(WORLDS, solved[:2], strict=True):
        yield from theorems.check_theorems(world, solution, 1e-9)


def of_modes(solved: list[Any]) -> Iterator[Check]:
    for row in theorems.check_modes(HIDDEN, solved[2], 1e-9):
        yield row._replace(name=f"{row.name}, modes")


def claim(row: Check) -> str:
    """The name and the first words of the statement."""
    return f"{row.name}: {' '.join(row.statement.split()[:4])}"


def worst(rows: Iterable[Check]) -> dict[str, Check]:
    """Every claim where it comes out worst."""
    found: dict[str, Check] = {}
    for row in rows:
        key = claim(row)
        worse = key not in found or ORDER.index(row.verdict) < ORDER.index(found[key].verdict)
        if row.expected and worse:
            found[key] = row
    return found


def spoilt(module: Any, name: str, spoil: Callable[..., Any]) -> Fault:
    """A fault in a function: `spoil` is given its result, and then its arguments."""

    def apply(patch: Patch) -> None:
        real = getattr(module, name)

        def faulty(*given: Any, **words: Any) -> Any:
            return spoil(real(*given, **words), *given)

        patch.setattr(module, name, faulty)

    return apply


def elsewhere(module: Any, name: str, *, modes: bool = False, **changes: Any) -> Fault:
    """A function of a world is given one that differs in `changes`; `modes`: only where the target has modes."""

    def apply(patch: Patch) -> None:
        real = getattr(module, name)

        def faulty(world: Any, *given: Any, **words: Any) -> Any:
            if (world.modes > 1) == modes:
                new = {key: f(world) if callable(f) else f for key, f in changes.items()}
                world = world.but(**new)
            return real(world, *given, **words)

        patch.setattr(module, name, faulty)

    return apply


def from_start(solution: int, spoil: Callable[[Any], Any]) -> Fault:
    """The solution of a world is another one."""
    return lambda _: [
        spoil(each) if place == solution else each for place, each in enumerate(solutions())
    ]


def none_on(solution: Any) -> Any:
    return replace(solution, table=PolicyTable.none(solution.table.task))


def w_is_v(patch: Patch) -> None:
    real = estimator._estimate

    def faulty(*given: Any) -> Any:
        *before, value, _, unsensed = given
        return real(*before, value, value, unsensed)

    patch.setattr(estimator, "_estimate", faulty)


def forgetful(patch: Patch) -> None:
    patch.setattr(
        BeliefFilter,
        "miss",
        lambda self, predicted, action: predicted / predicted.sum(-1, keepdims=True),
    )


def constant(solved: histories.HistoryQ, *_: Any) -> histories.HistoryQ:
    return replace(solved, value=dict.fromkeys(solved.value, -12345.0))


def as_printed(solved: histories.HistoryQ, *_: Any) -> histories.HistoryQ:
    """What follows a miss whose cell is known is taken for what follows a detection there."""
    value = {
        (x, history): solved.value[j, ()]
        for x, history in solved.value
        for j in range(4)
        if history and history[-1] == solved.without(j)
    }
    return replace(solved, value=solved.value | value)


def cost_on_exit(solved: histories.HistoryQ, *_: Any) -> histories.HistoryQ:
    return replace(solved, inside=dict.fromkeys(solved.inside, 1.0))


def dear(world: Any) -> Any:
    return 1.1 * world.cost


THEOREM_2 = "Theorem 2: V*_TMDP = V*_POMDP, by"
THEOREM_3 = "Theorem 3, exact form: the estimate from Q"
CLOCKED = "bound: the clocked bound solves"
VALUE = "value: the exact value of"
SEARCH = "search: branch and bound has"
PROVED = "search: the bound that branch"
FAULTS: dict[str, tuple[Fault, str]] = {
    # The six that passed once.
    "the proof's payment is halved": (
        spoilt(optimal, "payment", lambda paid, *_: 0.5 * paid),
        PROVED,
    ),
    "the joint loss is 1.3 times as large": (
        spoilt(Joint, "losses", lambda found, *_: tuple(1.3 * each for each in found)),
        SEARCH,
    ),
    "D is not charged with modes": (
        elsewhere(proofs, "value_of", modes=True, safe_cost=0.0),
        "value, modes: the exact value of",
    ),
    "a bound has dearer sensors": (elsewhere(bounds, "clocked", cost=dear), CLOCKED),
    "the estimator takes W = V": (w_is_v, "Theorem 3, differences: the estimator's differences of"),
    "Theorem 1 looks at no cell": (
        lambda patch: patch.setattr(theorems, "info_states", lambda *_: iter(())),
        "Theorem 1: p_j > c/r is",
    ),
    # Of values.
    "sensors are charged .1 % too much": (
        elsewhere(proofs, "value_of", cost=lambda world: 1.001 * world.cost),
        VALUE,
    ),
    "sensors never miss": (elsewhere(proofs, "value_of", detection=1.0), VALUE),
    "the safe action never misses": (elsewhere(proofs, "value_of", safe_detection=1.0), VALUE),
    # Of bounds.
    "the clock of the bound is a step short": (
        elsewhere(bounds, "clocked", t_max=lambda world: world.t_max - 1),
        CLOCKED,
    ),
    "the valid bound has dearer sensors": (
        elsewhere(bounds, "valid", cost=dear),
        "bound: the valid bound solves",
    ),
    "the valid bound with modes has dearer sensors": (
        elsewhere(bounds, "valid", modes=True, cost=dear),
        "bound, modes: the valid bound solves",
    ),
    "the bound with modes has dearer sensors": (
        elsewhere(bounds, "clocked", modes=True, cost=dear),
        "bound, modes: the clocked bound solves",
    ),
    "the printed bound is the valid one": (
        spoilt(bounds, "paper", lambda _, world: bounds.valid(world)),
        "Q_MDP: V*_QMDP as printed solves",
    ),
    "the clocked bound is too low": (
        spoilt(bounds, "clocked", lambda bound, _: bound - 10.0),
        "order: optimum <= clocked bound",
    ),
    "the valid bound is too low": (
        spoilt(bounds, "valid", lambda bound, _: bound - 10.0),
        "order: clocked bound <= valid",
    ),
    "the bound with modes is too low": (
        spoilt(bounds, "clocked", lambda bound, _: bound - 10.0),
        "order, modes: the policy found <=",
    ),
    # Of branch and bound, and of solve.
    "the tables of known positions are too low": (
        spoilt(known, "tables", lambda found, *_: [table - 0.02 for table in found]),
        SEARCH,
    ),
    "the bound one move late is too low": (
        spoilt(Delayed, "worth", lambda worth, *_: worth - 0.02),
        SEARCH,
    ),
    "open choices are forgotten": (spoilt(Tree, "upper", lambda _, tree: tree.best), SEARCH),
    "the bracket of solve is too low": (
        spoilt(optimal, "solve", lambda best, *_, **__: replace(best, bound=best.value - 0.1)),
        "search: the POMDP's optimum is",
    ),
    "D is not charged": (elsewhere(theorems.optimum, "solve", safe_cost=0.0), THEOREM_2),
    "sensors cost a tenth more": (elsewhere(theorems.optimum, "solve", cost=dear), THEOREM_2),
    "the POMDP's clock is a step short": (
        elsewhere(pomdp, "solve", t_max=lambda world: world.t_max - 1),
        THEOREM_2,
    ),
    # Of the theorems: policies, values of histories, the belief.
    "no sensor is ever on": (from_start(0, none_on), "Theorem 1: p_j > c/r is"),
    "no sensor is ever on, sharp": (from_start(0, none_on), "Theorem 1, sharp: p_j > c p_in"),
    "a miss is worth more than a detection": (
        spoilt(histories, "_going_on", lambda worth, *_: worth + 10.0),
        "Lemma 1, first: known at b but",
    ),
    "a miss is worth too little": (
        spoilt(histories, "_going_on", lambda worth, *_: worth - 10.0),
        "Lemma 1, second: with b sensed too,",
    ),
    "histories are worth a constant": (spoilt(histories, "solve_histories", constant), THEOREM_3),
    "W = V, as printed": (spoilt(histories, "solve_histories", as_printed), THEOREM_3),
    "sensors are charged on exit": (
        spoilt(histories, "solve_histories", cost_on_exit),
        THEOREM_3,
    ),
    "the belief forgets misses": (forgetful, THEOREM_3),
    "Q_MDP senses everything": (
        spoilt(rules, "qmdp", lambda _, world: PolicyTable.all_on(world)),
        "Q_MDP: threshold c/r: largest gain",
    ),
    "Q_MDP senses nothing": (
        spoilt(rules, "qmdp", lambda _, world: PolicyTable.none(world)),
        "Q_MDP: threshold c p_in /",
    ),
    "Q_MDP is valued too high": (
        spoilt(theorems, "value_of", lambda found, *_: replace(found, value=found.value + 100.0)),
        "order: Q_MDP <= optimum",
    ),
}
"""Fault -> how it is made, and the claim that has to fail. The names of the program's functions stand here alone."""
FIRST = [*{key: name for name, (_, key) in reversed(FAULTS.items())}.values()]
"""A fault for each claim."""
NO_CASE = {"Theorem 1", "Lemma 1", "Theorem 2", "Theorem 3", "Q_MDP"}
"""Statements without a case where the target has modes."""


@pytest.fixture(autouse=True)
def few_searches(monkeypatch: Patch) -> None:
    """Searches take most of the time: one cut early, and one to the end."""
    monkeypatch.setattr(proofs, "BUDGETS", proofs.BUDGETS[-2:])


@pytest.fixture
def no_searches(monkeypatch: Patch) -> None:
    monkeypatch.setattr(proofs, "of_searches", lambda: iter(()))


def test_without_a_fault_every_claim_holds_and_has_a_case(monkeypatch: Patch) -> None:
    monkeypatch.setattr(proofs, "of_searches", cache(lambda real=proofs.of_searches: [*real()]))
    found = worst(chain(of_cells(solutions()), of_modes(solutions())))
    without = {key.split(", modes")[0] for key in found if found[key].verdict == "no case"}
    assert without == NO_CASE
    assert {row.verdict for row in found.values()} == {"holds", "no case"}
    seen = {key for _, key in FAULTS.values()}
    assert seen == {key for key, row in found.items() if row.verdict == "holds"}


@pytest.mark.parametrize("name", [*FIRST, *later(name for name in FAULTS if name not in FIRST)])
def test_a_fault_is_noticed(name: str, monkeypatch: Patch, request: pytest.FixtureRequest) -> None:
    solved = solutions()  # before anything is faulty
    fault, key = FAULTS[name]
    if not key.startswith("search"):
        request.getfixturevalue("no_searches")
    rows = (of_modes if "modes: " in key else of_cells)(fault(monkeypatch) or solved)
    assert any(row.expected and row.verdict == "FAILS" for row in rows if claim(row) == key)


@pytest.mark.usefixtures("no_searches")
def test_an_open_bracket_is_no_counter_example() -> None:
    cut = [replace(none_on(solution), certified=False) for solution in solutions()[:2]]
    row = worst(of_cells(cut))["Theorem 1: p_j > c/r is"]
    assert (row.holds, row.verdict, row.passed) == (False, "open", True)
