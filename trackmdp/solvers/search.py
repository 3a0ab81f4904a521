"""Forward-and-backward search (Brown 1980, Washburn 1983) for plans of sets, led by a homotopy from the clocked bound.

With the value V of being located fixed, choosing the sets after each located cell is an optimal search for a moving
target. The sets before step t give the undetected mass m_t; the sets after it give W_t(j), the value of going on with
the target in j, undetected; and the best set of step t is {j : p_d(j) m_t(j) (r + V(j) - W_t(j)) > c_j sum(m_t)}. The
ascent ends where no change of one step's set gains, but sets may have to change together: to leave a cell out pays only
if it is looked at next. Starting from the optimistic credit of the clocked bound, r + U(j, 0) - U(j, n + 1), and moving
gradually to the exact one finds most of those joint optima (theory: continuation).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from trackmdp.policies.table import PolicyTable
from trackmdp.solvers import qmdp
from trackmdp.solvers.bounds import clocked_table
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.layers import Layer, layer_sets, policy_table, reachable_layers
from trackmdp.solvers.renewal import RenewalSystem, forced_worth, per_row
from trackmdp.world.model import Array, BoolArray, World

DIRECT_SEARCH = 1_500
"""Cells up to which the systems of a search are factorised: above, the value before is so near that iterating is
faster. What the search ends at is valued by `evaluate`, by its own rule."""


@dataclass(frozen=True)
class InnerProblem:
    """The search for the target from each located cell, the value of locating it given.

    Attributes:
        world: the problem.
        layers: possible positions before the first of the H sets to be chosen and after each move: H + 1 layers.
        detected: `[M]`, worth of sensing the target in each cell, r + V.
        missed: `[M]`, worth of the target being in each cell, undetected, after the last set.
        windowed: whether the task's window limits the sets; not where a known position stands for any located cell.
    """

    world: World
    layers: list[Layer]
    detected: Array
    missed: Array
    windowed: bool = True

    @classmethod
    def of(cls, world: World, layers: list[Layer], value: Array) -> InnerProblem:
        """The problem of one renewal: after the last set comes the safe action. `value`: `[M]`, V."""
        detected = world.reward + value
        return cls(world, layers, detected, forced_worth(world, detected))

    @property
    def length(self) -> int:
        """H, sets to be chosen."""
        return len(self.layers) - 1

    def undetected(self, sets: list[BoolArray]) -> list[Array]:
        """W_t per entry of each layer: what follows when the target is there, undetected, and `sets` go on."""
        # W_t(i) = sum_j P_ij [h_j (r + V(j)) + (1 - h_j) W_{t+1}(j)] - c(A_t) P_in(i), from the last set backwards; h_j
        # is the probability of a report, p_d(j) where j is sensed.
        # A set belongs to a located cell, so its price c(A_t) is that of the entry's row.
        later = [self.missed[self.layers[-1].cells]]
        for before, layer, on in reversed(list(zip(self.layers, self.layers[1:], sets, strict=False))):
            paid = per_row(layer.on_rows, on * self.world.cost[layer.sensors], self.world.num_cells)
            report = layer.seen(on) * self.world.detects(layer.cells)
            gross = layer.moves @ (report * self.detected[layer.cells] + (1.0 - report) * later[0])
            later.insert(0, gross - paid[before.rows] * self.world.stay_probability[before.cells])
        return later

    def worth(self, sets: list[BoolArray], mass: Array) -> Array:
        """`[M]` what `sets` earn from undetected `mass` (`[E]`, on the first layer)."""
        return per_row(self.layers[0].rows, mass * self.undetected(sets)[0], self.world.num_cells)

    def ascend(
        self,
        sets: list[BoolArray],
        mass: Array,
        *,
        sweeps: int,
        optimism: float = 0.0,
        credit: list[Array] | None = None,
        exact: bool = False,
    ) -> list[BoolArray]:
        """At most `sweeps` times, the best set at each step given the others; `sets` is left as it is.

        Args:
            sets: sensed entries of each layer but the first.
            mass: `[E]`, undetected mass on the first layer.
            sweeps: passes over the steps; ends early where nothing changes.
            optimism: weight of `credit` against the exact credit r + V - W_t.
            credit: per step, `[M]` optimistic credit.
            exact: whether the sets of sensors with footprints are the best ones, not only good ones.
        """
        for _ in range(sweeps):
            later, now, chosen = self.undetected(sets), mass, []
            for t, layer in enumerate(self.layers[1:]):
                # Row vectors: `now` [E_before] is undetected mass per entry, and `moves` [E_before, E] carries it one
                # step on.
                now = now @ layer.moves
                inside = per_row(layer.rows, now, self.world.num_cells)
                # later[0] belongs to layer 0, so what follows a miss at step t is later[t + 1].
                gain = self.detected[layer.cells] - later[t + 1]
                if credit is not None:
                    gain = optimism * credit[t][layer.cells] + (1.0 - optimism) * gain
                detects = self.world.detects(layer.cells)
                on = layer.best(sets[t], now * detects * gain, self.world.cost, inside, exact=exact)
                chosen.append(on & layer.allowed if self.windowed and layer.allowed is not None else on)
                now = now * (1.0 - layer.seen(chosen[-1]) * detects)
            if all((new == old).all() for new, old in zip(chosen, sets, strict=True)):
                break
            # All steps are replaced at once, each against the sets before it in this sweep and those after it in the
            # last one: the order of the forward-and-backward method, and each sweep is worth no less than the last.
            sets = chosen
        return sets

    def none_sensed(self) -> list[BoolArray]:
        """Sets to start from."""
        return [np.zeros(len(layer.sensors), dtype=bool) for layer in self.layers[1:]]


def solve(world: World, *, steps: int = 30, sweeps: int = 3) -> PolicyTable:
    """The policy found by the homotopy in `steps` steps of `sweeps` sweeps each, then by plain ascent.

    The better one of it and the clocked policy, so that it is never worse than that.
    """
    layers = reachable_layers(world, world.num_choices)
    first = layer_sets(layers, qmdp.clocked_policy(world))
    sets = follow_credit(world, layers, first, steps, sweeps)
    # The homotopy follows a credit that changes, so that it may end below the clocked policy it began with.
    found, simple = (located_value(world, layers, each) for each in (sets, first))
    return policy_table(world, layers, sets if found.sum() >= simple.sum() else first)


def follow_credit(
    world: World, layers: list[Layer], sets: list[BoolArray], steps: int = 30, sweeps: int = 3
) -> list[BoolArray]:
    """The homotopy from the clocked bound's credit to the exact one, from the clocked policy's `sets`."""
    table = clocked_table(world).table
    # sensing j at n misses gains r + U(j, 0) where leaving it would go on with U(j, n + 1)
    credit = list((world.reward + table[:, :1] - table[:, 1:]).T)
    # The renewals all start with mass 1 in the located cell: layer 0 is the identity, one entry per cell.
    value, located = table[:, 0], np.ones(world.num_cells)
    for step in range(steps + 1):
        problem = InnerProblem.of(world, layers, value)
        # Value and credit change together: V starts as U(., 0), and is the policy's own from the first step on.
        sets = problem.ascend(sets, located, sweeps=sweeps, optimism=1.0 - step / steps, credit=credit)
        # each step of the homotopy moves few sets, so that the value before is a good guess
        value = located_value(world, layers, sets, value)
    return ascended(world, layers, sets, value)


def ascended(
    world: World, layers: list[Layer], sets: list[BoolArray], value: Array | None = None, *, sweeps: int = 10
) -> list[BoolArray]:
    """Policy iteration by ascent, until the mean value no longer grows; `value` `[M]`: that of `sets`, where known."""
    located = np.ones(world.num_cells)
    value = located_value(world, layers, sets) if value is None else value
    exact = False
    while True:
        candidate = InnerProblem.of(world, layers, value).ascend(sets, located, sweeps=sweeps, exact=exact)
        same = all((new == old).all() for new, old in zip(candidate, sets, strict=True))
        better = value if same else located_value(world, layers, candidate, value)
        # Sums over all cells: V is compared from a uniform start, as AIHTR does; the margin is rounding.
        if better.sum() > value.sum() + 1e-12 * np.abs(value).sum():
            sets, value = candidate, better
        elif exact or world.coverage is None:
            return sets
        else:
            exact = True  # with footprints, once good sets gain no more, the best ones may


def located_value(world: World, layers: list[Layer], sets: list[BoolArray], guess: Array | None = None) -> Array:
    """`[M]` V of a policy given as sets on the layers, on large worlds by iteration from `guess` `[M]`."""
    if not world.safe:
        return evaluate(world, policy_table(world, layers, sets)).value
    m, mass, earned = world.num_cells, np.ones(world.num_cells), np.zeros(world.num_cells)
    hits = []
    for layer, on in zip(layers[1:], sets, strict=True):
        now = mass @ layer.moves
        inside = per_row(layer.rows, now, m)
        # c(A_t(x)); paid as long as the target is undetected and in the grid, so times the mass `inside`.
        paid, seen = per_row(layer.on_rows[on], world.cost[layer.sensors[on]], m), layer.seen(on)
        found = now[seen] * world.detects(layer.cells[seen])
        earned += world.reward * per_row(layer.rows[seen], found, m) - paid * inside
        # The entries of T(x, j): mass located in j after a plan made in x.
        hits.append((found, layer.rows[seen], layer.cells[seen]))
        mass = now * (1.0 - seen * world.detects(layer.cells))
    # what is left after the last set moves once more and is located by the safe action
    left = mass > 0
    missed = sparse.csr_array((mass[left], (layers[-1].rows[left], layers[-1].cells[left])), shape=(m, m))
    forced = missed @ world.kernel
    earned += (world.reward - world.safe_cost) * forced.sum(axis=1)
    data, rows, cells = (np.concatenate(part) for part in zip(*hits, strict=True))
    located = sparse.csr_array((data, (rows, cells)), shape=(m, m)) + forced
    return RenewalSystem(located, world.size, direct=DIRECT_SEARCH).solve(earned, guess)
