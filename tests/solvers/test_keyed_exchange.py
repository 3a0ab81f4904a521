"""Exchange for plans of keys: with one mode it finds the optimum of the cells, and it beats one set at a time."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import headings, random_kernel
from trackmdp.solvers import optimal
from trackmdp.solvers.keyed import KeyedPairs
from trackmdp.solvers.keyed_exchange import exchanged_pairs
from trackmdp.solvers.keyed_search import mode_bound
from trackmdp.world.model import World
from trackmdp.world.modes import HiddenWorld


def iterated(pairs: KeyedPairs, rounds: int = 8) -> float:
    """The best AIHTR of some rounds of exchange from no sensors at all."""
    sets, best = [np.zeros(len(groups), dtype=bool) for groups in pairs.groups], -np.inf
    for _ in range(rounds):
        value, visits, aihtr = pairs.value(sets)
        best, sets = max(best, aihtr), exchanged_pairs(pairs, sets, value, visits)
    return best


@pytest.mark.parametrize("detection", [1.0, 0.8])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_with_one_mode_it_finds_the_optimum_of_the_cells(seed: int, detection: float) -> None:
    kernel = random_kernel(np.random.default_rng(seed), 9, 0.1)
    known = {"cost": 0.12, "t_max": 1, "detection": detection}
    hidden = HiddenWorld(kernel, 3, modes=1, **known)
    assert iterated(KeyedPairs(hidden)) == pytest.approx(optimal.solve(World(kernel, 3, **known)).lower)


def test_one_set_at_a_time_stops_earlier() -> None:
    pairs = KeyedPairs(headings(3, 0.7, cost=0.12, memory="displacement"))
    sets, best, bound = [np.zeros(len(groups), dtype=bool) for groups in pairs.groups], -np.inf, mode_bound(pairs.world)
    for _ in range(8):
        value, visits, aihtr = pairs.value(sets)
        best, sets = max(best, aihtr), pairs.improved(sets, value, visits, bound, 0.0)
    assert iterated(pairs) > best


def test_cells_of_many_modes_are_decided_once_and_paid_once() -> None:
    """Given V and visits, the plans of every key are worth what a chain of sets earns by the exact recursion."""
    pairs = KeyedPairs(headings(3, 0.8, cost=0.2, memory="displacement"))
    sets = [np.ones(len(groups), dtype=bool) for groups in pairs.groups]
    value, visits, _ = pairs.value(sets)
    located, gathered = pairs.run(*pairs.of_policy(pairs.table(sets)))
    found = exchanged_pairs(pairs, sets, value, visits)
    other, spent = pairs.run(*pairs.of_policy(pairs.table(found)))
    # One step of policy improvement: what each pair earns until its next detection, and V from there on.
    before, after = (visits * (g[:, 0] + k @ value) for k, g in ((located, gathered), (other, spent)))
    first, second = (np.bincount(pairs.key, part) for part in (before, after))
    assert (second >= first - 1e-9).all()
    assert second.sum() > first.sum() + 1e-3
