"""Exchange: change one or two cells of one set, choose all later sets anew, and only then judge.

The ascent of `search` changes one set at a time and stops where two would have to change together: leaving a cell out
of one set pays only if a later set looks for the target where it then may be. So every candidate, the set of step t
with one or two cells flipped, is held while the sets after it are chosen anew by a forward-and-backward sweep; then
sweeps go over all of its sets, and what is worth more than the plan at hand, in exact expectation, replaces it.
How that is worked out is in `plans`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers import qmdp, search
from trackmdp.solvers.bounds import one_set
from trackmdp.solvers.layers import Layer, layer_sets, policy_table, reachable_layers
from trackmdp.solvers.plans import Chains, ChainStep, exchanged_parts, parts
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.solvers.search import InnerProblem, located_value
from trackmdp.world.model import Array, BoolArray, World

OTHERS, PRICES_OFF, _STEPS, MOST_STARTED = 4, 0.2, 5, 500
"""Other searches from t_max 2 on, how far the prices that lead them are off (standard deviation of their logarithms),
the steps of their homotopies, and the cells up to which they are made. On nine worlds of 9 x 9 and 10 x 10 cells four
gained up to .0007 per step, on diagonal walks .002 to .007, twelve as much again or less; prices .1 or .4 off gained no
more, nor did moves that are off, or 30 steps, for twice the time."""


def solve(world: World, starts: int = OTHERS) -> PolicyTable:
    """The policy of `search`, improved by exchange, and from t_max 2 on by what `starts` other searches find."""
    found = search.solve(world)
    if world.coverage is not None:
        return found
    layers = reachable_layers(world, world.num_choices)
    sets = exchanged(world, layers, layer_sets(layers, found))
    if world.num_choices > 2:
        sets = best_of(world, layers, sets, other_starts(world, layers, starts))
    return policy_table(world, layers, sets)


def other_starts(world: World, layers: list[Layer], count: int) -> Iterator[list[BoolArray]]:
    """What `search` finds where the prices that lead it are a little off; nothing on large grids."""
    rng = np.random.default_rng(derive(0, "exchange", "starts"))
    for _ in range(count if world.num_cells <= MOST_STARTED else 0):
        other = replace(world, cost=world.cost * np.exp(PRICES_OFF * rng.standard_normal(world.num_cells)))
        yield search.follow_credit(other, layers, layer_sets(layers, qmdp.clocked_policy(other)), _STEPS)


def best_of(
    world: World,
    layers: list[Layer],
    sets: list[BoolArray],
    others: Iterable[list[BoolArray]],
    value: Array | None = None,
    *,
    go_on: Callable[[], bool] = lambda: True,
) -> list[BoolArray]:
    """From each located cell the best plan that exchange makes of `sets` or of any of the `others`.

    Each cell takes a plan of its own, V given, so that no cell's value is lower than with `sets`; arguments as of
    `exchanged`.
    """
    located = np.ones(world.num_cells)
    value = located_value(world, layers, sets) if value is None else value
    for other in others:
        problem = InnerProblem.of(world, layers, value)
        ascended = problem.ascend(other, located, sweeps=10)
        # Where these are the plans at hand, exchange has been tried.
        found = exchange(problem, ascended, located, _changed(layers, sets, ascended), go_on)
        worth = problem.worth(sets, located)
        better = problem.worth(found, located) > worth + 1e-10 * (1.0 + np.abs(worth))
        if better.any():
            sets = [np.where(better[layer.rows], *on) for layer, *on in zip(layers[1:], found, sets, strict=True)]
            value = located_value(world, layers, sets, value)
    return exchanged(world, layers, sets, value, go_on=go_on)


def improve(world: World, policy: PolicyTable, *, once: bool = False) -> PolicyTable:
    """What exchange, or `once` a first round of it, makes of a deterministic `policy`; no cell's value is lower.

    Exchange is of cells, one sensor in each: sets of sensors with footprints ascend, by `search`.
    """
    layers = reachable_layers(world, world.num_choices)
    sets = layer_sets(layers, policy)
    if world.coverage is not None:
        return policy_table(world, layers, search.ascended(world, layers, sets))
    return policy_table(world, layers, exchanged(world, layers, sets, once=once))


def exchanged(
    world: World,
    layers: list[Layer],
    sets: list[BoolArray],
    value: Array | None = None,
    *,
    go_on: Callable[[], bool] = lambda: True,
    once: bool = False,
) -> list[BoolArray]:
    """Policy iteration by exchange, until the mean value no longer grows; no cell's value is lower than before.

    Args:
        world: the problem.
        layers: possible positions, from all located cells to those after t_max + 1 moves.
        sets: where to start, sensed entries of each layer but the first.
        value: `[M]`, that of `sets`, where known.
        go_on: asked before each part whether to look further.
        once: end after the first round, which gains most of it.
    """
    located, everywhere = np.ones(world.num_cells), np.ones(world.num_cells, dtype=bool)
    value = located_value(world, layers, sets) if value is None else value
    tried = everywhere
    while True:
        problem = InnerProblem.of(world, layers, value)
        candidate = exchange(problem, problem.ascend(sets, located, sweeps=10), located, tried, go_on)
        changed = _changed(layers, sets, candidate)
        better = located_value(world, layers, candidate, value) if changed.any() else value
        # Plans that are each worth no less, V given, make a policy of no less value anywhere (policy improvement), so
        # that the sum says whether there is any gain; the margin is rounding.
        if better.sum() > value.sum() + 1e-12 * np.abs(value).sum():
            # Where nothing was gained nothing is tried again, until the others have settled as well: V has then moved.
            sets, value, tried = candidate, better, changed
        elif tried.all() or not go_on():
            return sets
        else:
            tried = everywhere
        if once:
            return sets


def _changed(layers: list[Layer], before: list[BoolArray], after: list[BoolArray]) -> BoolArray:
    """`[M]` from which located cells the sets differ."""
    changed = np.zeros(len(layers[0].rows), dtype=bool)
    for layer, old, new in zip(layers[1:], before, after, strict=True):
        changed[layer.rows[old != new]] = True
    return changed


def exchange(
    problem: InnerProblem,
    sets: list[BoolArray],
    mass: Array,
    tried: BoolArray | None = None,
    go_on: Callable[[], bool] = lambda: True,
) -> list[BoolArray]:
    """Plans worth no less than `sets` from each located cell, the value of locating the target given.

    Args:
        problem: the search from each located cell.
        sets: sensed entries of each layer but the first; left as they are.
        mass: `[E]`, undetected mass on the first layer.
        tried: `[M]`, the located cells whose plans may change; None for all.
        go_on: asked before each part whether to look further.
    """
    worth = problem.worth(sets, mass)
    # A located cell whose plan is worth what it could be if the position were revealed after every set is done with.
    could_gain = revealed(problem, mass) - worth > 1e-9 * (1.0 + np.abs(worth))
    cells = np.flatnonzero(could_gain if tried is None else could_gain & tried)
    rows = len(could_gain)
    entries = np.max([np.bincount(layer.rows, minlength=rows) for layer in problem.layers], axis=0)[cells]
    each = itertools.takewhile(lambda _: go_on(), parts(entries))
    return exchanged_parts(sets, (_chains(problem, mass, cells[part]) for part in each))


def _chains(problem: InnerProblem, mass: Array, cells: IndexArray) -> tuple[Chains, Sequence[IndexArray]]:
    """The searches from the located `cells`, in order, and which entries of each layer but the first are theirs."""
    world, layers = problem.world, problem.layers
    # Entries are in order of their located cells: looking at no others, all parts of a grid together see each once.
    low, high = cells[0], cells[-1] + 1
    place = np.full(high - low, -1)
    place[cells - low] = np.arange(len(cells))
    spans = [slice(*np.searchsorted(layer.rows, (low, high))) for layer in layers]
    theirs = [place[layer.rows[span] - low] for layer, span in zip(layers, spans, strict=True)]
    kept = [span.start + np.flatnonzero(row >= 0) for span, row in zip(spans, theirs, strict=True)]
    rows = [row[row >= 0] for row in theirs]
    steps = []
    for t, layer in enumerate(layers[1:], start=1):
        entries, there, before = kept[t], layer.cells[kept[t]], kept[t - 1]
        number = np.cumsum(theirs[t] >= 0) - 1
        moves = layer.moves[before]  # to entries of the same located cells, which are all kept
        renamed = (moves.data, number[moves.indices - spans[t].start], moves.indptr)
        kept_moves = sparse.csr_array(renamed, shape=(len(before), len(entries)))
        chance = np.broadcast_to(world.detects(there), there.shape)
        stay = world.stay_probability[layers[t - 1].cells[before]]
        allowed = layer.allowed[entries] if problem.windowed and layer.allowed is not None else None
        worth, price = problem.detected[there], world.cost[there]
        steps.append(ChainStep(rows[t], kept_moves, worth, chance, price, stay, allowed=allowed))
    missed = problem.missed[layers[-1].cells[kept[-1]]]
    return Chains(rows[0], mass[kept[0]], steps, missed), kept[1:]


def revealed(problem: InnerProblem, mass: Array) -> Array:
    """`[M]` the worth of the best plans if the position were revealed after every set; no plan is worth more."""
    origin, worth = problem.layers[0], problem.missed
    for _ in range(problem.length):
        worth = one_set(problem.world, problem.detected, worth)
    return per_row(origin.rows, mass * worth[origin.cells], problem.world.num_cells)
