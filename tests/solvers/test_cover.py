"""Sensors with footprints: coverage problems, bounds and planners against brute force over sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.helpers import later, random_kernel, small_world
from tests.solvers.worlds import all_plans, best_of_all, followed, footprint_world
from trackmdp.arrays.entries import row_index
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Tracks
from trackmdp.sensing.choose import largest
from trackmdp.sensing.cover import Shared
from trackmdp.sensing.decisions import sensing
from trackmdp.sensing.programs import integer
from trackmdp.solvers import bounds, lookahead, optimal, rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.value import replay
from trackmdp.world.model import World

PLANNERS = (rules.clocked_policy, rules.qmdp, rules.fcr, rules.myopic)


BUDGETS = [
    None,
    1,
    pytest.param(0, marks=pytest.mark.slow),
    pytest.param(2, marks=pytest.mark.slow),
]


def one_move(world: World) -> Shared:
    """The decisions about the entries of one move from each cell, those of the kernel."""
    rows, cells = row_index(world.kernel), world.kernel.indices
    choice = sensing(world, rows, cells, world.num_cells)
    assert isinstance(choice, Shared)
    return choice


def from_cell_0(coverage: list[list[int]], cost: list[float]) -> World:
    """The target goes to cells 1 2 3 with .3 each."""
    kernel = np.zeros((len(coverage[0]),) * 2)
    kernel[0, 1:4] = 0.3
    return World(kernel, (1, len(kernel)), cost=cost, t_max=0, safe_cost=1.0, coverage=coverage)


def most_on(choice: Shared, on: Array) -> int:
    """The most sensors on in a row."""
    return int(np.bincount(choice.rows, weights=on.ravel() > 0).max())


def most_of(choice: Shared, gain: Array, price: Array) -> Array:
    """`[M]`, the best of all sets of each row."""
    best = np.zeros(choice.count)
    for row in range(choice.count):
        mine = np.flatnonzero(choice.rows == row)
        unseen = 1.0 - choice.sees[mine].toarray()
        for number in range(2 ** len(mine)):
            on = (number >> np.arange(len(mine))) & 1 > 0
            if choice.budget is not None and on.sum() > choice.budget:
                continue
            seen = 1.0 - unseen[on].prod(axis=0)
            best[row] = max(best[row], gain @ seen - price[mine][on].sum())
    return best


def test_three_overlapping_sensors_by_hand() -> None:
    """Sensors cover 1 2, 2 3 and all three: both small ones see all for .4, the large one for .5; one .6 for .2."""
    world = from_cell_0([[0, 1, 1, 0], [0, 0, 1, 1], [0, 1, 1, 1]], [0.2, 0.2, 0.5])
    choice = one_move(world)
    gain, price = world.kernel.data, world.cost[choice.sensors]
    on = choice.greedy(gain[:, None], price[:, None])[:, 0]
    assert choice.sensors[on].tolist() == [0, 1]
    assert choice.cover(gain, price, exact=True).upper == pytest.approx([0.9 - 0.4, 0, 0, 0])


def test_of_sensors_that_see_the_same_the_cheapest_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The target never goes to cell 4, which some sensors cover as well."""
    coverage = [[0, 1, 1, 0, 0], [0, 1, 1, 0, 1], [0, 1, 1, 0, 0], [0, 0, 0, 1, 1], [0, 0, 0, 1, 0]]
    world = from_cell_0(coverage, [0.3, 0.1, 0.1, 0.2, 0.1])
    choice = one_move(world)
    gain, price = world.kernel.data, world.cost[choice.sensors]
    assert choice.sensors[choice.distinct(price)].tolist() == [1, 4]
    for on in (
        choice.greedy(gain[:, None], price[:, None])[:, 0],
        choice.cover(gain, price).on,
        choice.cover(gain, price, exact=True).on,
    ):
        assert choice.sensors[on > 0].tolist() == [1, 4]
    # 3 sensors see cell 1, 3 cell 2 and 2 cell 3
    monkeypatch.setattr("trackmdp.sensing.cover._MOST", 7)
    with pytest.raises(UserError, match=r"coverage: 8 pairs of a cell .* expected at most 7"):
        one_move(world)


@pytest.mark.parametrize(("budget", "on", "worth"), [(None, 2, 2.8), (1, 1, 1.9), (0, 0, 0.0)])
def test_an_integer_program_keeps_to_the_budget(budget: int | None, on: int, worth: float) -> None:
    """Each of three sensors sees two of three entries, of 1 each, for .1: shares of 1/2 would see all."""
    sees = sparse.csr_array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0]])
    found, proved = integer(sees, np.ones(3), np.full(3, 0.1), budget)
    assert found.sum() == on
    assert proved == pytest.approx(worth, abs=1e-6)


def test_shares_are_rounded_within_the_budget() -> None:
    """Three sensors, each with an entry of its own that is worth .3, for .1; the third one has the smallest share."""
    choice = one_move(from_cell_0(np.eye(4)[1:].tolist(), [0.1, 0.1, 0.1]).but(budget=2))
    shares, price = np.array([0.7, 0.7, 0.6]), np.full(3, 0.1)
    on, upper = choice._rounded(shares, np.full(3, 0.3), price, np.array([0.4, 0.0, 0.0, 0.0]))
    assert on.tolist() == [True, True, False]
    assert upper.tolist() == pytest.approx([0.4, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("misses", [False, True])
@pytest.mark.parametrize("seed", [*range(8), *later(range(8, 20))])
def test_sets_and_bounds_of_coverage_problems(seed: int, misses: bool, budget: int | None) -> None:
    """Some gains are losses: cells that a set must not see."""
    rng, world = np.random.default_rng(seed), footprint_world(seed).but(budget=budget)
    if misses:
        world = replace(world, detection=rng.uniform(0.5, 0.9, world.num_cells))
    choice = one_move(world)
    gain = rng.normal(0.3, 0.4, world.kernel.nnz) * world.kernel.data
    price = (0.2 * rng.random(world.total_sensors))[choice.sensors]
    most, columns = most_of(choice, gain, price), (gain[:, None], price[:, None])

    def worth(on: Array) -> Array:
        return choice.worth(on.reshape(-1, 1) > 0, *columns)[:, 0]

    exact = choice.cover(gain, price, exact=True)
    for found in (choice.cover(gain, price), exact):
        assert (found.upper >= most - 1e-12).all()
    good, start = worth(choice.greedy(*columns)), rng.random((len(price), 1)) < 0.5
    assert (good <= most + 1e-12).all()
    assert good.sum() >= 0.9 * most.sum()
    found = choice.best(*columns, start)
    few = start if budget is None else start & largest(choice.rows, start.astype(float), budget)
    assert (worth(choice.best(*columns, few)) >= np.maximum(good, worth(few)) - 1e-12).all()
    assert (worth(found) >= good - 1e-12).all()
    if budget is not None:
        assert (
            max(most_on(choice, on) for on in (found, exact.on, choice.greedy(*columns))) <= budget
        )
    assert exact.upper == pytest.approx(most, abs=1e-9)
    assert worth(exact.on) == pytest.approx(most, abs=1e-9)
    # Each sensor switched over by itself.
    changes = choice.changes(start, *columns)[:, 0]
    for place, change in enumerate(changes):
        other = start.copy()
        other[place] ^= True
        assert worth(other).sum() - worth(start).sum() == pytest.approx(change, abs=1e-12)


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("listed", [0, 2, 14])
@pytest.mark.parametrize("seed", range(6))
def test_sets_are_the_best_whether_listed_or_solved_for(
    seed: int, listed: int, budget: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of at most `listed` sensors have all their sets gone through, the others integer programs."""
    rng = np.random.default_rng(seed)
    choice = one_move(footprint_world(seed).but(budget=budget))
    gain, price = rng.random(choice.sees.shape[1]), 0.8 * rng.random(len(choice.rows))
    monkeypatch.setattr("trackmdp.sensing.cover._LISTED", listed)
    found, most = choice.cover(gain, price, exact=True), most_of(choice, gain, price)
    worth = choice.worth(found.on[:, None] > 0, gain[:, None], price[:, None])[:, 0]
    assert worth == pytest.approx(most, abs=1e-9)
    assert found.upper == pytest.approx(most, abs=1e-9)


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("misses", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_a_good_set_depends_on_no_other_row_or_candidate(
    seed: int, misses: bool, budget: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows and candidates that are settled are left out of the further changes of the others."""
    monkeypatch.setattr("trackmdp.sensing.cover._WORTH_PARTS", 0)
    rng, world = np.random.default_rng(seed), footprint_world(seed).but(budget=budget)
    choice = one_move(replace(world, detection=0.8) if misses else world)
    gain = rng.normal(0.3, 0.4, (choice.sees.shape[1], 8)) * world.kernel.data[:, None]
    price = np.tile((0.2 * rng.random(len(choice.rows)))[:, None], 8)
    start = rng.random(price.shape) < 0.5
    on = choice.best(gain, price, start)
    for row in range(choice.count):
        mine = np.flatnonzero(choice.rows == row)
        entries = np.unique(choice.sees[mine].indices)
        alone = choice.part(mine, entries, np.array([row]))
        for column in range(8):
            each = [column]
            found = alone.best(
                gain[np.ix_(entries, each)], price[np.ix_(mine, each)], start[np.ix_(mine, each)]
            )
            assert (found[:, 0] == on[mine, column]).all()


@pytest.mark.parametrize("limit", [{"_LISTED": 1}, {"_MOST_SETS": 5}, {"_AT_ONCE": 8}], ids=str)
@pytest.mark.parametrize("seed", range(6))
def test_sets_of_many_sensors_that_miss(
    seed: int, limit: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows with few sensors have the best of all sets, in whatever parts; the others good ones, and a bound."""
    rng, world = np.random.default_rng(seed), footprint_world(seed)
    world = replace(world, detection=rng.uniform(0.5, 0.9, world.num_cells))
    choice = one_move(world)
    gain = rng.uniform(0.2, 0.8, world.kernel.nnz) * world.kernel.data
    price = (0.1 * rng.random(world.total_sensors))[choice.sensors]
    [[name, value]] = limit.items()
    monkeypatch.setattr(f"trackmdp.sensing.cover.{name}", value)
    found, most = choice.cover(gain, price, exact=True), most_of(choice, gain, price)
    worth = choice.worth(found.on[:, None] > 0, gain[:, None], price[:, None])[:, 0]
    best = found.upper <= most + 1e-9
    assert (found.upper >= most - 1e-12).all()
    assert worth[best] == pytest.approx(most[best], abs=1e-9)
    assert worth.sum() >= 0.9 * most.sum()
    assert best.all() == (name == "_AT_ONCE")


def test_a_bracket_is_no_wider_than_to_the_clocked_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where many sensors that miss share cells, the bound by good sets lies far above it."""
    world = small_world(3).but(coverage=np.eye(9) + np.eye(9, k=1), detection=0.8)
    monkeypatch.setattr("trackmdp.sensing.cover._LISTED", 1)
    clocked = bounds.clocked(world).mean()
    assert bounds._clocked(world, exact=True).value.mean() > clocked + 0.1
    assert optimal.solve(world).upper <= clocked + 1e-9
    monkeypatch.undo()
    bounds.exact_clocked_table.cache_clear()
    solution = optimal.solve(world)
    assert solution.certified
    assert solution.upper < clocked - 0.1


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("misses", [False, True])
@pytest.mark.parametrize("seed", [*range(3), *later(range(3, 12))])
def test_bounds_and_planners_against_all_plans(seed: int, misses: bool, budget: int | None) -> None:
    world = footprint_world(seed).but(budget=budget)
    if misses:
        chances = np.random.default_rng(seed).uniform(0.5, 0.9, world.num_cells)
        world = replace(world, detection=chances)
    best, linear, exact = (
        best_of_all(world),
        bounds.clocked_table(world),
        bounds.exact_clocked_table(world),
    )
    for upper in (linear.value, exact.value, bounds.valid(world)):
        assert (upper >= best - 1e-8).all()
    assert (exact.value <= linear.value + 1e-7).all()
    short = replace(world, max_steps=4)
    most = bounds.clocked(short)
    for plan in (*PLANNERS, lookahead.solve):
        assert (evaluate(world, plan(world)).value <= best + 1e-8).all()
        assert (evaluate(short, plan(short)).value <= most + 1e-8).all()
    solution = optimal.solve(world)
    assert solution.value == pytest.approx(best, abs=1e-7)
    assert (solution.bound >= best - 1e-8).all()
    assert solution.certified
    if world.t_max == 0:  # one set from each cell: the bound that reveals the cell is the optimum
        assert exact.value == pytest.approx(best, abs=1e-7)


@pytest.mark.parametrize("budget", BUDGETS)
@pytest.mark.parametrize("seed", [*range(4), *later(range(4, 10))])
def test_sets_ahead_are_the_best_plans_of_small_worlds(seed: int, budget: int | None) -> None:
    world = footprint_world(seed).but(budget=budget, t_max=1)
    value, sets = bounds.clocked_table(world).table[:, 0], lookahead.solve(world).dense()
    for z in range(world.num_cells):
        most, worth = (
            (earned + located @ value).max()
            for earned, located, _ in (
                all_plans(world, z),
                followed(world, z, [sets[z, n][None] for n in range(2)]),
            )
        )
        assert worth == pytest.approx(most, abs=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_the_unit_of_rewards_and_prices_changes_no_proof(seed: int) -> None:
    world, unit = footprint_world(seed), 1e-12
    small = world.but(reward=unit, cost=unit * world.cost, safe_cost=unit * world.safe_cost)
    best = optimal.solve(small)
    assert best.certified
    assert best.lower == pytest.approx(unit * optimal.solve(world).lower, rel=1e-6)


def test_footprints_of_one_cell_in_another_order_are_the_papers_sensors() -> None:
    rng = np.random.default_rng(5)
    world = World(random_kernel(rng, 9, 0.1), 3, cost=0.2 * rng.random(9), t_max=1, safe_cost=2.0)
    # Footprints to a task: sensor s covers cell 8 - s.
    turned = World.of(world, world.kernel, coverage=np.eye(9)[::-1], cost=world.cost[::-1])
    assert turned.coverage is not None
    for plan in PLANNERS:
        mine, other = plan(world), plan(turned)
        assert (mine.dense() == other.dense()[..., ::-1]).all()
        assert evaluate(turned, other).value == pytest.approx(
            evaluate(world, mine).value, abs=1e-12
        )
    for bound in (bounds.paper, bounds.valid, bounds.clocked):
        assert bound(turned) == pytest.approx(bound(world), abs=1e-9)
    probability = rng.random((9, 2, 9))
    drawn = (
        PolicyTable.from_dense(world, probability),
        PolicyTable.from_dense(turned, probability[..., ::-1]),
    )
    assert evaluate(turned, drawn[1]).value == pytest.approx(
        evaluate(world, drawn[0]).value, abs=1e-12
    )


def test_the_identity_is_no_footprint_at_all() -> None:
    world = small_world()
    same = World.of(world, world.kernel, coverage=np.eye(9))
    assert same.coverage is None
    assert np.array_equal(
        evaluate(same, rules.qmdp(same)).value, evaluate(world, rules.qmdp(world)).value
    )


def test_policies_that_draw_see_a_cell_unless_all_its_sensors_are_off() -> None:
    coverage = [[1, 1, 0, 0], [0, 1, 1, 0], [0, 1, 0, 0]]
    world = World(np.full((4, 4), 0.2), 2, cost=0.1, t_max=0, safe_cost=0.5, coverage=coverage)
    cells = np.arange(4)

    def chances(probability: float, k: int | None) -> Array:
        return PolicyTable(world, probability=probability, k=k).reports(0, 0 * cells, cells)

    assert chances(0.5, None) == pytest.approx([0.5, 0.875, 0.5, 0.0])
    # Of two of three sensors: one given sensor is among them with 2/3, and some of three always.
    assert chances(2 / 3, 2) == pytest.approx([2 / 3, 1.0, 2 / 3, 0.0])
    every_pair = [
        PolicyTable.from_dense(world, np.tile(~np.eye(3, dtype=bool)[s], (4, 1, 1)))
        for s in range(3)
    ]
    # One step, then the safe action: the reward of drawing a pair is the mean of those of the three pairs.
    each = [evaluate(replace(world, max_steps=1), policy).aihtr for policy in every_pair]
    drawn = evaluate(replace(world, max_steps=1), PolicyTable(world, probability=2 / 3, k=2))
    assert drawn.aihtr == pytest.approx(np.mean(each))
    assert drawn.sensors_per_step == pytest.approx(2.0)


def test_recorded_tracks_are_replayed_with_footprints() -> None:
    """From cell 0 to 3 on a line, and out: the sensor of cells 1 and 2 sees two of three steps, for .25 each."""
    world = World(
        np.diag(np.full(3, 0.9), 1),
        (1, 4),
        cost=0.25,
        t_max=3,
        safe_cost=2.0,
        coverage=[[0, 1, 1, 0]],
    )
    tracks = Tracks(np.array([0, 1, 2, 3]), np.array([0, 4]), np.array([True]), np.array([0]))
    found = replay(world, tracks, PolicyTable.all_on(world))
    assert found.totals[0, 0] == pytest.approx(2 - 3 * 0.25)


def test_methods_that_need_a_sensor_a_cell() -> None:
    world = footprint_world(0)
    with pytest.raises(UserError, match="one cell"):
        evaluate(world, PolicyTable.all_on(world), false_alarm=0.1)
