"""Positions revealed one move late: the tables against every plan there is, and what they are worth to the tree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.solvers.worlds import paper_world, random_tiny_world
from trackmdp.arrays.types import Array
from trackmdp.solvers import optimal
from trackmdp.solvers.certify import delayed
from trackmdp.solvers.certify.choices import LeftOut
from trackmdp.solvers.certify.delayed import Delayed
from trackmdp.solvers.motion_totals import forced_worth
from trackmdp.world.model import World


def _best(world: World, mass: Array, sets: int, detected: Array, missed: Array) -> Array:
    """`[B]` F_h of each row of `mass` `[B, M]`, every set tried at every step."""
    if not sets:
        return mass @ missed
    m, moved = world.num_cells, mass @ world.kernel.toarray()
    found = np.full(len(mass), -np.inf)
    for number in range(2**m):
        on = (number >> np.arange(m)) % 2
        seen = moved * on * world.detection
        now = seen @ detected - (world.cost @ on) * moved.sum(axis=1)
        found = np.maximum(found, now + _best(world, moved - seen, sets - 1, detected, missed))
    return found


def _worlds(count: int, seed: int) -> list[tuple[World, Array, Array]]:
    """Tiny worlds, half of them with misses, and any values of locating the target and of having missed it."""
    rng, made = np.random.default_rng(seed), []
    for number in range(count):
        world = replace(random_tiny_world(rng), t_max=2)
        if number % 2:
            world = replace(
                world, detection=rng.uniform(0.5, 1.0, world.num_cells), safe_detection=0.8
            )
        detected = world.reward + rng.normal(0.0, 1.0, world.num_cells)
        made.append((world, detected, forced_worth(world, detected)))
    return made


def test_no_plan_beats_the_tables_and_what_is_exact_is() -> None:
    closed = 0
    for world, detected, missed in _worlds(12, seed=0):
        tables = Delayed.of(world, detected, missed, 3)
        assert tables is not None
        m, z = tables.successors.shape
        for sets in (1, 2, 3):
            best = _best(world, np.eye(m), sets, detected, missed)
            assert (tables.revealed[sets] >= best - 1e-9).all()
            if sets < 3:
                np.testing.assert_allclose(tables.revealed[sets], best, atol=1e-9)
        for number in range(2**z):
            # the mass of P_i on the successors in the set, and of what sensors on the others miss
            is_left = np.zeros((m, m), dtype=bool)
            moves = np.diff(world.kernel.indptr)
            for i in range(m):
                is_left[i, tables.successors[i, : moves[i]]] = (
                    number >> np.arange(moves[i])
                ) % 2 > 0
            mass = world.kernel.toarray() * np.where(is_left, 1.0, 1.0 - world.detection)
            for sets in (0, 1, 2):
                best = _best(world, mass, sets, detected, missed)
                assert (tables.left[sets][:, number] >= best - 1e-9).all()
                if sets < 2:
                    np.testing.assert_allclose(tables.left[sets][:, number], best, atol=1e-9)
                else:
                    closed += int((tables.left[2][:, number] < best + 1e-9).sum())
    assert closed > 200


@pytest.mark.parametrize("closed", [False, True], ids=["some on", "all on"])
def test_mass_from_several_cells_is_worth_no_more_than_each_by_itself(closed: bool) -> None:
    rng = np.random.default_rng(1)
    for world, detected, missed in _worlds(12, seed=2):
        tables = Delayed.of(world, detected, missed, 3)
        assert tables is not None
        m = world.num_cells
        before, on = rng.random((5, m)) * (rng.random((5, m)) < 0.7), rng.random((5, m)) < 0.5
        on |= closed
        rows, cells = np.nonzero(~on)
        bound = tables.worth(sparse.csr_array(before), LeftOut.of(rows, cells, m), 2)
        moved = before @ world.kernel.toarray()
        best = _best(world, moved * (1.0 - on * world.detection), 2, detected, missed)
        assert (bound >= best - 1e-9).all()
        # no looser than with the position revealed after the move
        assert (bound <= moved * (1.0 - on * world.detection) @ tables.revealed[2] + 1e-9).all()


def test_subgradient_steps_only_tighten_the_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    world = paper_world(5, 0.22, 3)
    value = optimal.solve(world, nodes=1).value
    detected = world.reward + value
    missed = forced_worth(world, detected)
    tables = {}
    for steps in (1, 6):
        monkeypatch.setattr(delayed, "STEPS", steps)
        made = Delayed.of(world, detected, missed, 4)
        assert made is not None
        tables[steps] = made.left[2]
    assert (tables[6] <= tables[1] + 1e-12).all()
    assert (tables[6] < tables[1] - 1e-3).any()


def test_worlds_with_many_successors_go_without() -> None:
    world = World(np.full((16, 16), 0.99 / 16), 4, cost=0.1, t_max=1)
    assert Delayed.of(world, np.ones(16), np.zeros(16), 2) is None
