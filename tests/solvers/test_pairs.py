"""Every pair of features against the definition: values, bounds, simulation and brute force, drawn by hypothesis."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import sparse

from tests.solvers.chain import (
    FIGURES,
    by_cell,
    chain_of,
    choosable,
    clocked,
    figures_of,
    key_of,
    subsets,
    totals_of,
)
from tests.solvers.worlds import best_of_all
from tests.tracks import by_hand
from trackmdp.config.world import MEMORIES
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.policy import Policy
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded
from trackmdp.sensing.task import Task
from trackmdp.solvers import bounds, value
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.solve import solve
from trackmdp.solvers.value import key_visits, visits_of
from trackmdp.world.model import World
from trackmdp.world.problem import Problem

SIZES = ((1, 3), (3, 1), (2, 2), (1, 4), (2, 3))
SENSORS = ("own", "footprints", "chances")


def numbers(rng: np.random.Generator, count: int, low: float, high: float, each: bool) -> Any:
    """A number, or with `each` one for each of `count`."""
    return rng.uniform(low, high, count) if each else float(rng.uniform(low, high))


def sensing(draw: st.DrawFn, rng: np.random.Generator, cells: int, most: int) -> dict[str, Any]:
    """Footprints of up to `most` sensors, misses and prices."""
    kind, given = draw(st.sampled_from(SENSORS)), dict[str, Any]()
    count = cells
    if kind != "own":
        count = int(rng.integers(2, most + 1))
        coverage = (rng.random((count, cells)) < 0.5).astype(float)
        coverage[np.arange(count), rng.integers(cells, size=count)] = 1.0
        given["coverage"] = coverage
    if kind == "chances":
        given["coverage"] = coverage * rng.choice([1.0, 0.8, 0.3], size=coverage.shape)
    if draw(st.booleans()):
        given["detection"] = numbers(rng, cells, 0.3, 1.0, draw(st.booleans()))
    if draw(st.booleans()):
        given["safe_detection"] = numbers(rng, cells, 0.4, 1.0, draw(st.booleans()))
    given["cost"] = numbers(rng, count, 0.0, 0.6, draw(st.booleans()))
    if draw(st.booleans()):
        given["cost"] = np.broadcast_to(given["cost"], (count,)).copy()
        given["cost"][rng.integers(count)] = np.nan
    return given


@st.composite
def problems(
    draw: st.DrawFn,
    *,
    sizes: tuple[tuple[int, int], ...] = SIZES,
    t_max: int = 2,
    most: int = 4,
    limits: tuple[int | None, ...] = (None, 1, 5),
    tracks: bool = True,
    modes: tuple[int, ...] = (1, 2),
    reveals: tuple[bool, ...] = (False, True),
    memories: Sequence[str] = (*MEMORIES,),
) -> Problem:
    """A world with or without modes, or recorded tracks, with any sensors, limits and memory."""
    size = draw(st.sampled_from(sizes))
    cells, rng = size[0] * size[1], np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    given = sensing(draw, rng, cells, most)
    given["t_max"] = draw(st.integers(0, t_max))
    given["max_steps"] = draw(st.sampled_from(limits))
    given["window"] = draw(st.sampled_from([None, None, 0, 1]))
    given["memory"], given["clip"] = draw(st.sampled_from(memories)), draw(st.sampled_from([1, 2]))
    given["reward"] = draw(st.sampled_from([1.0, 2.0]))
    given["safe_cost"] = float(rng.uniform(0.0, 2.0))
    if tracks and draw(st.booleans()):
        parts = [rng.integers(cells, size=rng.integers(2, 9)).tolist() for _ in range(4)]
        lines = by_hand(*parts, exits=rng.random(4) < 0.6)
        return Recorded(lines, size, validation=lines, held_out=lines, **given)
    of_cell = draw(st.sampled_from(modes))
    states = cells * of_cell
    kernel = rng.random((states, states)) ** 2 * (rng.random((states, states)) < 2.5 / states)
    kernel[np.arange(states), rng.integers(states, size=states)] += 0.3
    kernel *= (1.0 - rng.choice([0.1, 0.3], size=(states, 1))) / kernel.sum(axis=1, keepdims=True)
    shown = draw(st.sampled_from(reveals))
    return World(kernel, size, modes=of_cell, reveals=shown, **given)


def random_policy(task: Task, seed: int, *, draws: bool = False) -> PolicyTable:
    """Any set of the sensors that can be chosen, or their probabilities, for every key and n."""
    rng = np.random.default_rng(seed)
    located = np.repeat(np.arange(task.num_cells), task.num_keys // task.num_cells)
    shape = (task.num_keys, task.num_choices, task.total_sensors)
    on = (rng.random(shape) < 0.5) & choosable(task)[located][:, None]
    table = on * rng.random(shape) if draws else on
    return PolicyTable(task, sparse.csr_array(table.reshape(-1, task.total_sensors)))


def close(found: Any, expected: Any) -> None:
    scale = 1.0 + np.nanmax(np.abs(expected), initial=0.0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * scale)


def check_values(problem: Problem, seed: int, draws: bool) -> None:
    policy = random_policy(problem, seed, draws=draws)
    totals, found = totals_of(problem, policy), evaluate(problem, policy)
    close(found.value, by_cell(problem, totals[:, 0]))
    for each, column in (("steps", 1), ("detections", 2), ("sensors", 3), ("safe_actions", 4)):
        close(getattr(found, each), by_cell(problem, totals[:, column]))
    for name, expected in figures_of(totals).items():
        close(getattr(found, name), expected)


@settings(max_examples=80)
@given(problems(), st.integers(0, 2**16), st.booleans())
def test_values_are_those_of_the_chain(problem: Problem, seed: int, draws: bool) -> None:
    check_values(problem, seed, draws)


@pytest.mark.long
@settings(max_examples=2000)
@given(problems(), st.integers(0, 2**16), st.booleans())
def test_values_of_many_more(problem: Problem, seed: int, draws: bool) -> None:
    check_values(problem, seed, draws)


@settings(max_examples=40)
@given(problems(), st.integers(0, 2**16), st.integers(1, 4))
def test_values_do_not_depend_on_how_many_events_are_followed_at_once(
    problem: Problem, seed: int, count: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(value, "_AT_ONCE", count)
        check_values(problem, seed, draws=False)


@settings(max_examples=40)
@given(problems(), st.integers(0, 2**16))
def test_searches_value_policies_as_evaluation_does(problem: Problem, seed: int) -> None:
    """And plans of all keys, each event weighted by its visits, are worth the visits times the value."""
    problem = replace(problem, max_steps=None)
    policy = random_policy(problem, seed)
    renewal = Renewal(problem, problem.motion)
    sets = renewal.sets(policy)
    system, earned = renewal.system(sets)
    value, visits = system.solve(earned), visits_of(system, renewal.start)
    table = renewal.table(sets)  # without the sensors that cannot see the target
    assert value[renewal.first].mean() == pytest.approx(evaluate(problem, table).aihtr, abs=1e-9)
    worth = renewal.problem(value, visits).worth(sets)[:, 0]
    known = renewal.count - renewal.events.forced
    expected = np.bincount(renewal.owner[:known], (visits * value)[:known], len(renewal.plans))
    close(worth, expected)
    close(
        key_visits(problem, table)[renewal.plans],
        np.bincount(renewal.owner[:known], visits[:known]),
    )


@settings(max_examples=40)
@given(problems(tracks=False), st.integers(0, 2**16))
def test_bounds_are_those_of_the_definition_and_above_every_policy(world: World, seed: int) -> None:
    bound, expected = bounds.clocked(world), clocked(world)
    slack = 1e-9 * (1.0 + np.abs(expected).max())
    if world.coverage is None:
        close(bound, expected)
    elif world.perfect and world.max_steps is None:
        exact = bounds.exact_clocked_table(world)
        close(bounds.of_cells(world, exact.table[:, 0]), expected)
        # What integer programs are solved to adds up over an episode.
        assert 0.0 <= exact.error <= 10 * slack
        assert (bounds.of_cells(world, exact.value) >= expected - slack).all()
    assert (bound >= expected - slack).all()
    assert (bounds.valid(world) >= bound - slack).all()
    for draws in (False, True):
        value = totals_of(world, random_policy(world, seed, draws=draws))[:, 0]
        assert (by_cell(world, value) <= expected + slack).all()


TINY: dict[str, Any] = {"limits": (None,), "tracks": False, "most": 3}


@settings(max_examples=25)
@given(
    st.one_of(
        problems(**TINY, sizes=((1, 3), (2, 2)), t_max=1, modes=(1,)),
        problems(**TINY, sizes=((1, 2), (1, 3)), t_max=1, modes=(2,), reveals=(True,)),
    )
)
def test_solving_finds_the_best_plans_where_a_detection_reveals_the_state(world: World) -> None:
    best, found = bounds.of_cells(world, best_of_all(world)), solve(world)
    slack = 1e-8 * (1.0 + np.abs(best).max())
    close(found.value, by_cell(world, totals_of(world, found.table)[:, 0]))
    assert (found.value <= best + slack).all()
    assert (found.bound >= best - slack).all()
    assert found.lower >= best.mean() - 1e-6 * (1.0 + abs(best.mean()))


def best_of_keys(world: World) -> float | None:
    """The AIHTR of the best plans of all keys that can occur, t_max being 0; None where there are too many.

    The moves out of a place depend on the set of its own key alone: those of the chains of one set for all keys, which
    are asked for at all places, since one set for all keys need not come to all of them.
    """
    everything = np.repeat(choosable(world), world.num_keys // world.num_cells, axis=0)

    def chain(share: Any, others: Any = ()) -> Any:
        return chain_of(world, PolicyTable(world, sparse.csr_array(everything * share)), others)

    every, sets = chain(0.5), subsets(world)
    number = {place: i for i, place in enumerate(every.places)}
    keys, owner = np.unique(
        [key_of(world, history) for _, history, _ in every.places], return_inverse=True
    )
    if len(sets) ** len(keys) > 4096:
        return None
    moves = np.zeros((len(sets), len(number), len(number)))
    earned = np.zeros((len(sets), len(number)))
    for each, on in enumerate(sets):
        part = chain(on, every.places)
        place = np.array([number[one] for one in part.places])
        moves[each][np.ix_(place, place)] = part.moves.toarray()
        earned[each][place] = part.earned[:, 0]
    choices = np.array(list(itertools.product(range(len(sets)), repeat=len(keys))))[:, owner]
    rows = np.arange(len(number))
    value = np.linalg.solve(
        np.eye(len(rows)) - moves[choices, rows], earned[choices, rows][..., None]
    )
    return float(value[:, every.starts, 0].mean(axis=1).max())


HIDDEN = {"modes": (2,), "reveals": (False,), "sizes": ((1, 2),), "t_max": 0}


def check_keys(world: World) -> None:
    best = best_of_keys(world)
    assume(best is not None)
    found = solve(world)
    close(found.value, by_cell(world, totals_of(world, found.table)[:, 0]))
    assert found.upper >= best - 1e-9 * (1.0 + abs(best))
    assert found.lower == pytest.approx(best, rel=1e-8, abs=1e-8)


@settings(max_examples=5)
@given(problems(**(TINY | HIDDEN), memories=("cell", "displacement")))
def test_solving_finds_the_best_plans_of_keys_where_modes_are_hidden(world: World) -> None:
    check_keys(world)


@pytest.mark.long
@settings(max_examples=60)
@given(problems(**(TINY | HIDDEN | {"sizes": ((1, 2), (1, 3))}), memories=[*MEMORIES][:2]))
def test_best_plans_of_keys_of_many_more(world: World) -> None:
    check_keys(world)


@settings(max_examples=12)
@given(problems(limits=(None, 5)), st.integers(0, 2**16), st.booleans())
def test_simulated_episodes_have_the_exact_figures(
    problem: Problem, seed: int, draws: bool
) -> None:
    """800 episodes, within 4 standard errors."""
    policy = random_policy(problem, seed, draws=draws)
    expected = figures_of(totals_of(problem, policy))
    played = simulate(problem, Policy.from_table(policy), 800, seed=seed).figures()
    for name in FIGURES:
        found = getattr(played, name)
        assert abs(found.mean - expected[name]) <= 4.0 * found.standard_error + 1e-9, name
