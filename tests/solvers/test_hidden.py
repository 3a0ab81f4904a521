"""Targets with a hidden heading: searches over keys, their bound, and the motion averaged over modes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.helpers import headings
from trackmdp.environment.env import TrackEnv
from trackmdp.motion.modes import heading_kernel
from trackmdp.solvers import bounds, exchange, hidden, optimal, search
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.renewal import Renewal
from trackmdp.solvers.search import Found
from trackmdp.solvers.solve import solve
from trackmdp.world.make import make_world
from trackmdp.world.model import World


@pytest.mark.parametrize(
    ("keep", "cost", "loss"), [(0.9, 0.16, 0.052), (0.7, 0.16, 0.033), (0.9, 0.08, 0.014)]
)
def test_a_revealed_heading_leaves_little_to_lose(keep: float, cost: float, loss: float) -> None:
    """Per step to the bound that knows the heading at all times, on 6 x 6: at most as in the prototype."""
    kernel, modes = heading_kernel(6, keep=keep, go=0.9, exit_probability=0.01)
    world = World(kernel, 6, modes=modes, cost=cost, t_max=1, reveals=True)
    best = optimal.solve(world)
    lost = (bounds.clocked(world).mean() - best.lower) / best.evaluation.expected_length
    assert 0.8 * loss < lost < loss + 0.001
    assert best.certified


def test_a_revealed_mode_is_worth_more_than_any_memory() -> None:
    known, remembered = solve(headings(revealed=8)), solve(headings(memory="displacement_gap"))
    assert remembered.lower < known.lower <= known.upper <= remembered.upper + 1e-9
    # A policy of the displacement alone is worth the same where the mode is revealed.
    again = evaluate(headings(revealed=8), remembered.table)
    assert again.aihtr == pytest.approx(remembered.lower)


def test_the_bound_holds_for_every_memory_and_memory_pays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hidden, "_MOST_KICKS", 0)  # they take most of the time
    cell, more = (
        solve(headings(5, 0.9, cost=0.16, memory=memory)) for memory in ("cell", "displacement")
    )
    assert cell.upper == pytest.approx(more.upper)
    assert cell.lower < more.lower < more.upper
    # Forgetting the heading costs more than half of the loss.
    assert more.upper - more.lower < 0.5 * (cell.upper - cell.lower)
    started = hidden.solve(headings(5, 0.9, cost=0.16), start=cell.table)
    assert started.lower >= cell.lower


def test_exchange_goes_on_where_one_set_at_a_time_stops() -> None:
    world = headings(3, 0.7, cost=0.12, memory="displacement")
    renewal = Renewal(world, world.motion)
    none = [np.zeros(len(choice.rows), dtype=bool) for choice in renewal.choices]
    start = Found(renewal, none)
    one = search.ascended(renewal, start)
    assert exchange.exchanged(renewal, start).aihtr > one.aihtr > start.aihtr


def test_kicks_end_above_what_a_learner_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """On 3 x 3 cells a run of `model_based` ended at 37.2789, the searches without kicks below it."""
    world = make_world("heading", size=3)
    assert solve(world).lower > 37.2789
    monkeypatch.setattr(hidden, "_MOST_KICKS", 0)
    assert evaluate(world, hidden.best_found(world)).aihtr < 37.2789


def test_less_effort_is_fewer_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine cells of eight modes are 72 events: one search without effort, 300 / 72 with a twentieth of 6,000 events."""
    world, begun = make_world("heading", size=3), list[int]()
    starts = hidden._starts
    monkeypatch.setattr(
        hidden, "_starts", lambda *args: [begun.append(1) or each for each in starts(*args)]
    )
    counts = []
    for effort in (0.0, 0.05):
        begun.clear()
        hidden.best_found(world, effort=effort)
        counts.append(len(begun))
    assert counts == [1, 4]


def test_averaged_moves_are_those_of_the_environment() -> None:
    """Counted over 20,000 steps, cell to cell; the mode differs from cell to cell at the border."""
    world = headings(keep=0.9)
    cells = hidden.averaged(world)
    assert (cells.memory, cells.revealed, cells.modes, cells.kernel.shape) == ("cell", 1, 1, (9, 9))
    env, seen = TrackEnv(world, 2000, seed=1), np.zeros((9, 10))
    state = env.reset()
    for _ in range(40):
        before = env.target.numpy()
        state["action"] = torch.ones(2000, 9, dtype=torch.bool)
        frame, state = env.step_and_maybe_reset(state)
        after = np.where(frame["next", "terminated"].squeeze(-1), 9, frame["next", "last_cell"])
        np.add.at(seen, (before, after), 1)
    total = seen.sum(axis=1, keepdims=True)
    expected = np.append(cells.kernel.toarray(), 1 - cells.kernel.sum(axis=1)[:, None], axis=1)
    error = np.sqrt(expected * (1 - expected) / total)
    assert (np.abs(seen / total - expected) < 5 * error + 1e-12).all()
