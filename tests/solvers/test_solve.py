"""Every registered solver, by name: what any of them must do, whatever it does well."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.solvers.chain import by_cell, totals_of
from tests.solvers.worlds import best_of_all, paper_world, tiny_worlds
from trackmdp.config import GROUPS
from trackmdp.errors import UserError
from trackmdp.solvers import bounds, optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.solution import SearchProgress, Solution
from trackmdp.solvers.solve import solve
from trackmdp.world.model import World

SOLVERS = sorted(GROUPS["solver"])


def rectangle(
    rng: np.random.Generator, rows: int, columns: int, window: int | None, t_max: int = 1
) -> World:
    """A world whose target moves up to one cell, most moves at random, so that two moves may leave a window of one.

    Sensors are cheap enough to be wanted there, and too dear to be switched on at once.
    """
    m = rows * columns
    row, column = np.divmod(np.arange(m), columns)
    near = np.maximum(np.abs(row[:, None] - row), np.abs(column[:, None] - column)) <= 1
    table = rng.random((m, m)) ** 6 * near
    table *= 0.9 / table.sum(axis=1, keepdims=True)
    return World(table, (rows, columns), cost=rng.uniform(0.1, 0.5, m), t_max=t_max, window=window)


def distance(world: World) -> np.ndarray:
    """`[M, M]` rows or columns between two cells, the larger number."""
    row, column = np.divmod(np.arange(world.num_cells), world.columns)
    return np.maximum(np.abs(row[:, None] - row), np.abs(column[:, None] - column))


@pytest.mark.parametrize("solver", SOLVERS)
@settings(max_examples=10)
@given(world=tiny_worlds(most_t_max=2))
def test_a_solution_is_what_it_says(solver: str, world: World) -> None:
    """Value by stepping through the plans one set at a time; the optimum of all plans within the bracket."""
    solution = solve(world, solver)
    scale = 1.0 + np.abs(solution.bound).max()
    value = by_cell(world, totals_of(world, solution.table)[:, 0])
    np.testing.assert_allclose(solution.value, value, rtol=0, atol=1e-9 * scale)
    assert (solution.value <= solution.bound + 1e-9 * scale).all()
    best = best_of_all(world)
    assert (solution.value <= best + 1e-8 * scale).all()
    assert (best <= solution.bound + 1e-8 * scale).all()


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_same_world_gives_the_same_policy_and_figures(solver: str) -> None:
    first, again = (solve(paper_world(5, 0.22, 2), solver) for _ in range(2))
    assert (first.table.sets != again.table.sets).nnz == 0
    assert np.array_equal(first.value, again.value)
    assert np.array_equal(first.bound, again.bound)


@pytest.mark.parametrize("solver", SOLVERS)
@settings(max_examples=4)
@given(seed=st.integers(0, 2**31))
def test_with_a_window_only_sensors_in_it_are_chosen(solver: str, seed: int) -> None:
    world = rectangle(np.random.default_rng(seed), 3, 4, window=1, t_max=2)
    solution = solve(world, solver)
    sets = solution.table.dense()
    assert sets.any()
    assert not sets[np.broadcast_to((distance(world) > 1)[:, None], sets.shape)].any()
    assert (solution.value <= bounds.clocked(world) + 1e-9).all()


@pytest.mark.slow
@settings(max_examples=8)
@given(seed=st.integers(0, 2**31))
def test_the_optimum_with_a_window_is_that_of_all_plans_within_it(seed: int) -> None:
    """On 2 x 3 cells every pair of sets within the window is tried; wide windows change nothing."""
    rng = np.random.default_rng(seed)
    world = rectangle(rng, 2, 3, window=1)
    best = best_of_all(world)
    solution = solve(world, tolerance=1e-9)
    assert solution.certified
    np.testing.assert_allclose(solution.value, best, rtol=0, atol=1e-7)
    words = {"cost": world.cost, "t_max": world.t_max}
    wide, free = (
        solve(World(world.kernel, (2, 3), window=window, **words)) for window in (2, None)
    )
    assert np.array_equal(wide.value, free.value)


def test_the_bracket_and_the_figures_are_those_of_the_parts() -> None:
    solution = solve(paper_world(5, 0.22, 1), "clocked")
    assert isinstance(solution, Solution)
    assert solution.lower == solution.evaluation.aihtr == solution.value.mean()
    assert solution.upper == solution.bound.mean()
    assert not solution.certified
    assert evaluate(paper_world(5, 0.22, 1), solution.policy).aihtr == solution.lower
    assert (solution.policy.sets != solution.table.sets).nnz == 0


def test_nothing_is_searched_where_the_clocked_policy_attains_its_bound(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Z = 3 at any price: at most one possible cell is left unsensed."""
    monkeypatch.delattr(optimal, "follow_credit")
    seen: list[SearchProgress] = []
    solution = solve(paper_world(3, 0.16, 3), on_progress=seen.append)
    assert solution.certified
    assert solution.nodes == 0
    assert len(seen) == 1
    assert (solution.table.sets != solve(paper_world(3, 0.16, 3), "clocked").table.sets).nnz == 0


@pytest.mark.parametrize(
    ("solver", "options", "said"),
    [
        ("optimum", {}, "optimum"),
        ("qmdp", {"depth": 2}, "depth"),
        ("lookahead", {"depth": 0}, "depth"),
        ("optimal", {"time_limit": -1}, "time_limit"),
    ],
)
def test_wrong_words_are_told_in_one_line(solver: str, options: dict, said: str) -> None:
    with pytest.raises(UserError, match=said) as error:
        solve(paper_world(3, 0.16, 1), solver, **options)
    assert "\n" not in str(error.value)


def test_only_whole_episodes_are_searched() -> None:
    world = World(np.full((4, 4), 0.2), 2, cost=0.1, t_max=1, max_steps=9)
    with pytest.raises(UserError, match="max_steps"):
        solve(world)


def test_solving_from_the_command_line_loads_no_torch(tmp_path: Path) -> None:
    words = ["solve", "grid.size=4", "quiet=true", f"hydra.run.dir={tmp_path}"]
    code = f"import sys; from trackmdp.app.cli import main; main({words!r}); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "False"
    assert (tmp_path / "solution.json").is_file()
