"""Exchange: change one or two cells of one set, choose all later sets anew, and only then judge.

The ascent of `search` changes one set at a time and stops where two would have to change together: leaving a cell out
of one set pays only if a later set looks for the target where it then may be. So every candidate, the set of step t
with one or two cells flipped, is held while the sets after it are chosen anew by a forward-and-backward sweep; then
sweeps go over all of its sets, and what is worth more than the plan at hand, in exact expectation, replaces it.

The candidates of all located cells are worked on together, as columns: `[E, C]` has a row for each entry of a layer (a
pair of located cell and possible position) and a column for each of the C = 33 candidates of that located cell. With
E_t entries in layer t and Z successors per cell, a sweep over all H = t_max + 1 steps takes 2 C Z (E_0 + ... + E_H-1)
multiplications, and the candidates of the H - 1 steps take about three sweeps each; E_t is at most M min(Z^t, M). Some
3 H + 10 arrays of 8 C E bytes are alive at once, E being the largest E_t of a part: located cells are gone through in
parts, so that one array holds about `MOST_NUMBERS` numbers at most, or those of one located cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.seeding import derive
from trackmdp.solvers import clocked, search
from trackmdp.solvers.layers import Layer, layer_sets, policy_table, reachable_layers
from trackmdp.solvers.renewal import IndexArray, per_row, row_index
from trackmdp.solvers.search import InnerProblem, located_value
from trackmdp.world.model import Array, BoolArray, World

MOST_NUMBERS = 2**17
"""Numbers in one array of a part, 1 MB: larger parts leave the caches, and took twice the time."""
SINGLES, PAIRED = 12, 7
"""Cells of one set that are flipped alone, and how many of these in pairs: those nearest to the other choice first."""
LATER_SWEEPS, ALL_SWEEPS = 1, 2
"""Sweeps over the sets after the flip alone, then over all sets. More of the first gained nothing on drifts and walks;
with one of the second, regrets of .001 to .004 are left there."""
STARTS, PRICES_OFF, MOST_STARTED = 4, 0.2, 500
"""Other searches from t_max 2 on, how far the prices that lead them are off (standard deviation of their logarithms),
and the cells up to which they are made. On nine worlds of 9 x 9 and 10 x 10 cells four gained up to .0007 per step, on
diagonal walks .002 to .007, twelve as much again or less; prices .1 or .4 off, or moves, gained no more."""


def _candidates() -> BoolArray:
    """`[SINGLES + 1, C]` whether the cell of each rank is flipped in each candidate; the last row is for all others."""
    pairs = [*((rank,) for rank in range(SINGLES)), *itertools.combinations(range(PAIRED), 2)]
    flipped = np.zeros((SINGLES + 1, len(pairs)), dtype=bool)
    for candidate, ranks in enumerate(pairs):
        flipped[list(ranks), candidate] = True
    return flipped


FLIPPED = _candidates()


def solve(world: World, starts: int = STARTS) -> PolicyTable:
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
        yield search.follow_credit(other, layers, layer_sets(layers, clocked.solve(other)))


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
        found = exchange(problem, problem.ascend(other, located, sweeps=10), located, go_on=go_on)
        worth = problem.worth(sets, located)
        better = problem.worth(found, located) > worth + 1e-10 * (1.0 + np.abs(worth))
        if better.any():
            sets = [np.where(better[layer.rows], *on) for layer, *on in zip(layers[1:], found, sets, strict=True)]
            value = located_value(world, layers, sets, value)
    return exchanged(world, layers, sets, value, go_on=go_on)


def improve(world: World, policy: PolicyTable) -> PolicyTable:
    """What exchange makes of a deterministic `policy`; no cell's value is lower.

    Exchange is of cells, one sensor in each: sets of sensors with footprints ascend, by `search`.
    """
    layers = reachable_layers(world, world.num_choices)
    sets = layer_sets(layers, policy)
    better = exchanged(world, layers, sets) if world.coverage is None else search.ascended(world, layers, sets)
    return policy_table(world, layers, better)


def exchanged(
    world: World,
    layers: list[Layer],
    sets: list[BoolArray],
    value: Array | None = None,
    *,
    go_on: Callable[[], bool] = lambda: True,
) -> list[BoolArray]:
    """Policy iteration by exchange, until the mean value no longer grows; no cell's value is lower than before.

    Args:
        world: the problem.
        layers: possible positions, from all located cells to those after t_max + 1 moves.
        sets: where to start, sensed entries of each layer but the first.
        value: `[M]`, that of `sets`, where known.
        go_on: asked before each part whether to look further.
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
    improved = [on.copy() for on in sets]
    worth = problem.worth(sets, mass)
    # A located cell whose plan is worth what it could be if the position were revealed after every set is done with.
    could_gain = revealed(problem, mass) - worth > 1e-9 * (1.0 + np.abs(worth))
    for cells in _parts(problem.layers, np.flatnonzero(could_gain if tried is None else could_gain & tried)):
        if not go_on():
            break
        part = PlansPart(problem, cells, mass)
        plans = part.exchange([on[entries] for on, entries in zip(sets, part.entries[1:], strict=True)])
        for on, entries, plan in zip(improved, part.entries[1:], plans, strict=True):
            on[entries] = plan
    return improved


def revealed(problem: InnerProblem, mass: Array) -> Array:
    """`[M]` the worth of the best plans if the position were revealed after every set; no plan is worth more."""
    kernel, world, worth = problem.world.kernel, problem.world, problem.missed
    rows, cells, p = row_index(kernel), kernel.indices, kernel.data
    report, price = world.detects(cells), world.cost[cells] * world.stay_probability[rows]
    for _ in range(problem.length):
        left = worth[cells]
        gain = p * report * (problem.detected[cells] - left) - price
        worth = per_row(rows, p * left + np.maximum(gain, 0.0), world.num_cells)
    return per_row(problem.layers[0].rows, mass * worth[problem.layers[0].cells], world.num_cells)


def _parts(layers: list[Layer], cells: IndexArray) -> Iterator[IndexArray]:
    """The located cells `cells` `[K]`, as many at once as `MOST_NUMBERS` allows."""
    most = layers[0].rows.max(initial=-1) + 1
    entries = np.max([np.bincount(layer.rows, minlength=most) for layer in layers], axis=0)[cells]
    # Located cells with 40, 50 and 30 entries, and room for 100: their sums 40, 90, 120 fall into the parts 0, 0, 1.
    room = max(1, MOST_NUMBERS // FLIPPED.shape[1])
    number = (np.cumsum(entries) - 1) // room
    yield from np.split(cells, np.flatnonzero(np.diff(number)) + 1) if len(cells) else []


class PlansPart:
    """The plans of some located cells and their candidates.

    Attributes:
        entries: of each layer, which entries belong to these cells.
    """

    def __init__(self, problem: InnerProblem, cells: IndexArray, mass: Array) -> None:
        world, layers = problem.world, problem.layers
        place = np.full(world.num_cells, -1)
        place[cells] = np.arange(len(cells))
        self.entries = [np.flatnonzero(place[layer.rows] >= 0) for layer in layers]
        kept = list(zip(layers, self.entries, strict=True))
        self.length = problem.length
        # Rows are numbered 0 ... K - 1 within the part; columns `[E, 1]` to stand beside candidates `[E, C]`.
        self.rows = [place[layer.rows[entries]] for layer, entries in kept]
        self.cells = [layer.cells[entries] for layer, entries in kept]
        # Index 0 is filled with what is not used, so that step t has the index t everywhere.
        self.moves = [
            sparse.csr_array(layer.moves[before][:, entries])
            for (layer, entries), before in zip(kept, [self.entries[0][:0], *self.entries], strict=False)
        ]
        self.back = [sparse.csr_array(moves.T) for moves in self.moves]
        self.sums = [summing(rows, len(cells)) for rows in self.rows]
        self.detected = [problem.detected[each][:, None] for each in self.cells]
        self.cost = [world.cost[each][:, None] for each in self.cells]
        self.reports = [np.broadcast_to(world.detects(each), each.shape)[:, None] for each in self.cells]
        self.stay = [world.stay_probability[each][:, None] for each in self.cells]
        self.missed = problem.missed[self.cells[-1]][:, None]
        self.allowed = [
            None if layer.allowed is None or not problem.windowed else layer.allowed[entries][:, None]
            for layer, entries in kept
        ]
        self.mass = mass[self.entries[0]][:, None]

    def exchange(self, sets: list[BoolArray]) -> list[BoolArray]:
        """The better plans `[E]` per step, from the `sets` of the same cells; the last set is always a best answer."""
        plan = [on[:, None] for on in sets]
        worth = self.worth(plan)
        for step in range(1, self.length):
            mass = self.pushed(plan, step)
            first = plan[step - 1] ^ FLIPPED[self.ranks(step, plan, mass)]
            # The sets before the flip are held in these sweeps, so that they need no more than the mass that is left.
            later = [np.repeat(on, first.shape[1], axis=1) for on in plan[step:]]
            later = self.ascend(later, self.missing(step, first, mass), step, LATER_SWEEPS)
            held = [np.repeat(on, first.shape[1], axis=1) for on in plan[: step - 1]]
            plan, worth = self.better(plan, worth, self.ascend([*held, first, *later], self.mass, 0, ALL_SWEEPS))
        return [on[:, 0] for on in plan]

    def better(self, plan: list[BoolArray], worth: Array, candidates: list[BoolArray]) -> tuple[list[BoolArray], Array]:
        """The best candidate of each located cell in place of its plan, if it is worth more; and what that is worth."""
        found = self.worth(candidates)
        best = found.argmax(axis=1)[:, None]
        reached = np.take_along_axis(found, best, axis=1)
        gains = reached > worth + 1e-10 * (1.0 + np.abs(worth))
        chosen = [
            np.where(gains[rows], np.take_along_axis(on, best[rows], axis=1), old)
            for on, old, rows in zip(candidates, plan, self.rows[1:], strict=True)
        ]
        return chosen, np.where(gains, reached, worth)

    def pushed(self, plan: list[BoolArray], step: int) -> Array:
        """`[E, 1]` undetected mass at `step`, before its set is sensed."""
        mass = self.mass
        for t in range(1, step):
            mass = self.missing(t, plan[t - 1], self.back[t] @ mass)
        return self.back[step] @ mass

    def ranks(self, step: int, plan: list[BoolArray], mass: Array) -> IndexArray:
        """`[E]` how near the choice at each entry of `step` is to the other one, 0 the nearest; SINGLES: never."""
        gain = mass * self.reports[step] * (self.detected[step] - self.undetected(plan[step:], step)[0])
        price = self.cost[step] * (self.sums[step] @ mass)[self.rows[step]]
        # Free sensors come last: there is no price that would make them nearly worth leaving out.
        margin = np.divide(np.abs(gain - price), price, out=np.full_like(gain, np.inf), where=price > 0)[:, 0]
        possible = mass[:, 0] > 0
        rank = ranked(self.rows[step], margin, possible)
        if (allowed := self.allowed[step]) is not None:
            possible &= allowed[:, 0]
        return np.where(possible, np.minimum(rank, SINGLES), SINGLES)

    def undetected(self, sets: list[BoolArray], since: int) -> list[Array]:
        """W_t `[E, C]` per layer from `since` on: what follows when the target is there, missed, and `sets` go on."""
        # The recursion of `InnerProblem.undetected`, for a column of each candidate.
        later = [self.missed]
        for t, on in zip(range(self.length, since, -1), reversed(sets), strict=True):
            paid = self.sums[t] @ (on * self.cost[t])
            gross = self.moves[t] @ (later[0] + np.where(on, self.reports[t] * (self.detected[t] - later[0]), 0.0))
            later.insert(0, gross - paid[self.rows[t - 1]] * self.stay[t - 1])
        return later

    def missing(self, t: int, on: BoolArray, mass: Array) -> Array:
        """`[E, C]` the `mass` at step t that is still undetected after the set `on`."""
        return mass * (1.0 - on * self.reports[t])

    def worth(self, sets: list[BoolArray]) -> Array:
        """`[K, C]` what whole plans earn from each located cell."""
        return self.sums[0] @ (self.mass * self.undetected(sets, 0)[0])

    def ascend(self, sets: list[BoolArray], mass: Array, since: int, sweeps: int) -> list[BoolArray]:
        """At most `sweeps` times, the best set at each step after `since` given the others; see `InnerProblem.ascend`.

        Args:
            sets: `[E, C]` per step after `since`.
            mass: `[E, C]` or `[E, 1]`, undetected mass on the layer `since`.
            since: the step whose set, and those before it, are held.
            sweeps: passes over the steps.
        """
        for _ in range(sweeps):
            later, now, chosen = self.undetected(sets, since), mass, []
            for t in range(since + 1, self.length + 1):
                now = self.back[t] @ now
                on = self.best(t, now, self.reports[t] * (self.detected[t] - later[t - since]))
                chosen.append(on)
                now = self.missing(t, on, now)
            if all((new == old).all() for new, old in zip(chosen, sets, strict=True)):
                break
            sets = chosen
        return sets

    def best(self, t: int, mass: Array, gain: Array) -> BoolArray:
        """`[E, C]` the best set at step t, where sensing `mass` there gains `gain` times as much."""
        on: BoolArray = mass * gain > self.cost[t] * (self.sums[t] @ mass)[self.rows[t]]
        allowed = self.allowed[t]
        return on if allowed is None else on & allowed


def summing(index: IndexArray, count: int) -> sparse.csr_array:
    """`[count, E]` that sums the entries of each index, whatever the number of columns (`per_row` is for one)."""
    return sparse.csr_array((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))


def ranked(rows: IndexArray, margin: Array, possible: BoolArray) -> IndexArray:
    """`[E]` place of each entry among those of its row, least margin first, what is not possible last."""
    order = np.lexsort((margin, ~possible, rows))
    # Entries are in order of their rows, and ranks run from 0 within each: with rows 0 0 1 1 1 the first entries
    # are 0 0 2 2 2, and the ranks of `order` 0 1 0 1 2.
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - np.searchsorted(rows, rows)
    return rank
