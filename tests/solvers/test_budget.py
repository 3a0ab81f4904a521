"""Budgets: at most B sensors on in a step, or b on average; against brute force, and against the dual over prices."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.helpers import later
from tests.solvers.worlds import best_of_all, paper_world, random_tiny_world
from trackmdp.app.cli import main
from trackmdp.environment.env import TrackEnv
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.sensing.choose import largest
from trackmdp.solvers import rules
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.frontier import frontier, relative_prices
from trackmdp.solvers.lookahead import solve as looked_ahead
from trackmdp.solvers.solve import run_solver, solve
from trackmdp.world.model import World


def tiny(seed: int, budget: int) -> World:
    world = random_tiny_world(np.random.default_rng(seed))
    return world.but(budget=budget, t_max=min(world.t_max, 2))


def test_the_largest_of_each_row_are_kept_and_of_equal_ones_the_first() -> None:
    rows, net = np.array([0, 0, 0, 2, 2]), np.array([[1.0, 3], [2, 3], [3, 3], [-1, 0], [5, 0]])
    kept = [[False, True], [True, True], [True, False], [True, True], [True, True]]
    np.testing.assert_array_equal(largest(rows, net, 2), kept)


@pytest.mark.parametrize("seed", range(12))
def test_optimum_of_tiny_worlds_is_that_of_brute_force(seed: int) -> None:
    world = tiny(seed, seed % 3)
    found = solve(world)
    assert found.certified
    assert found.table.most_on <= seed % 3
    np.testing.assert_allclose(found.value, best_of_all(world), rtol=1e-9, atol=1e-9)


def test_a_budget_above_all_sensors_is_none() -> None:
    world = tiny(6, 0)
    one, other = solve(world.but(budget=10**18)), solve(world.but(budget=None))
    np.testing.assert_allclose(one.value, other.value, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", [*range(4), *later(range(4, 100))])
def test_no_policy_with_a_budget_is_above_the_dual_over_prices(seed: int) -> None:
    world = tiny(seed, 1)
    dual = frontier(world.but(cost=0.2, budget=None), near=1.0)
    for price in (0.0, 0.2):
        best = float(best_of_all(world.but(cost=price)).mean())
        assert best <= dual.worth(1.0, price) + 1e-9


@pytest.mark.parametrize("seed", [0, *later(range(1, 6))])
def test_corners_of_a_frontier_with_a_budget_are_optima_of_their_prices(seed: int) -> None:
    world = tiny(seed, 1)
    edge, free = frontier(world), frontier(world.but(budget=None))
    assert edge.certified
    assert max(corner.table.most_on for corner in edge.corners) == 1
    for corner in edge.corners:
        priced = world.but(cost=corner.price * relative_prices(world.cost))
        assert corner.evaluation.aihtr == pytest.approx(float(best_of_all(priced).mean()), abs=1e-7)
        assert corner.net <= free.bound(corner.sensors) + 1e-9


def test_dual_is_tight_where_the_budget_is_one_on_average() -> None:
    world = paper_world(5, 0.16, 1, 6)
    found = frontier(world, near=1.5)
    mixture = found.at(sensors=1.5)
    value = sum(w * evaluate(world, corner.table).aihtr for w, corner in mixture.parts)
    assert mixture.sensors == pytest.approx(1.5)
    assert value == pytest.approx(found.worth(1.5, 0.16), rel=1e-5)
    assert len(found.slopes) < 30  # the other corners are not looked for


@pytest.mark.slow
@pytest.mark.parametrize("budget", [1, 2, 3])
@pytest.mark.parametrize("pair", [(3, 0.16), (4, 0.2), (5, 0.22)])
def test_optimum_of_the_papers_pairs_is_proved(pair: tuple[int, float], budget: int) -> None:
    found = solve(paper_world(*pair, 1).but(budget=budget))
    assert (found.upper - found.lower) / found.evaluation.expected_length < 1e-5
    assert found.table.most_on == min(budget, found.table.most_on)


def test_prices_near_the_least_of_all_numbers_are_prices() -> None:
    least, free = (
        solve(tm.make_world("random_walk", size=3, cost=cost, budget=1, safe_cost=1.0)).lower
        for cost in (5e-324, 0.0)
    )
    assert least == pytest.approx(free)


def test_rules_keep_to_the_budget_by_the_largest_gains() -> None:
    world = paper_world(5, 0.16, 1, 4).but(budget=2)
    free = world.but(budget=None)
    for rule in (rules.qmdp, rules.fcr, rules.myopic, rules.clocked_policy, looked_ahead):
        assert rule(world).most_on == 2
        assert rule(free).most_on > 2
    # The clock is at 0: the first set of the budgeted Q_MDP is a part of the free one's.
    first, whole = rules.qmdp(world).dense()[:, 0], rules.qmdp(free).dense()[:, 0]
    assert (first <= whole).all()
    assert (first.sum(axis=1) == np.minimum(whole.sum(axis=1), 2)).all()


def test_bounds_hold_with_hidden_modes_windows_and_misses() -> None:
    rng = np.random.default_rng(3)
    given: dict[str, Any] = {"cost": 0.1, "budget": 1, "safe_cost": 0.5, "t_max": 1}
    kernel = rng.dirichlet(np.ones(8), 8) * 0.9
    for world in (
        World(kernel, 2, modes=2, **given),
        World(kernel, 2, modes=2, reveals=True, **given),
        World(kernel, (2, 4), window=1, **given),
        World(kernel, (2, 4), detection=0.5 + 0.5 * rng.random(8), **given),
    ):
        found = solve(world)
        assert found.table.most_on == 1
        assert found.lower <= found.upper + 1e-12
        assert found.upper <= solve(world.but(budget=None)).upper + 1e-9


def test_environment_refuses_more_sensors_and_draws_fewer() -> None:
    env = TrackEnv(tm.make_world(size=4, budget=2), 8)
    assert int(env.rollout(20, break_when_any_done=False)["action"].sum(-1).max()) <= 2
    state = env.reset()
    action = torch.zeros(8, 16, dtype=torch.bool)
    action[3, :3] = True
    with pytest.raises(UserError, match="action: 3 sensors on, expected at most the budget, 2"):
        env.step(state.set("action", action))


def test_policies_with_more_sensors_are_refused() -> None:
    world = tm.make_world(size=4, budget=2)
    with pytest.raises(UserError, match="up to 16 sensors on in a step; expected 2"):
        evaluate(world, "all_on")
    with pytest.raises(UserError, match="up to 3 sensors on in a step; expected 2"):
        evaluate(world, Policy.random_k(world, 3))
    assert 0 < evaluate(world, Policy.random_k(world, 2)).sensors_per_step <= 2


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        (["verify", "cost.budget=2"], "cost.budget=2: expected null here"),
        (["train", "cost.budget=2", "algo=hindsight"], "algo=hindsight: expected one of a2c, "),
        (["solve", "cost.mean_budget=2", "solver=qmdp"], "cost.mean_budget=2"),
        (["evaluate", "baseline=qmdp", "cost.mean_budget=2"], "cost.mean_budget=2"),
        (["solve", "cost.mean_budget=2", "cost.budget=3"], "cost.mean_budget=2"),
    ],
)
def test_words_without_effect_are_refused(
    words: list[str], refusal: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main([*words, f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert refusal in capsys.readouterr().err


def test_a_mean_budget_gives_two_policies_and_how_often_to_draw_each(tmp_path: Path) -> None:
    words = ["solve", "grid.size=4", "quiet=true", f"hydra.run.dir={tmp_path}"]
    assert main([*words, "cost.mean_budget=0.7"]) == 0
    content = json.loads((tmp_path / "mean_budget.json").read_text(encoding="utf-8"))
    parts = content["parts"]
    assert sum(each["probability"] * each["sensors_per_step"] for each in parts) == pytest.approx(
        0.7
    )
    assert content["lower"] == pytest.approx(content["upper"], rel=1e-5)
    assert (tmp_path / "mean_budget" / "1" / "sets.json").is_file()
    assert main(words) == 0
    assert not (tmp_path / "mean_budget.json").exists()
    assert main([*words, "cost.mean_budget=9"]) == 0
    content = json.loads((tmp_path / "mean_budget.json").read_text(encoding="utf-8"))
    assert content["binding"] is False


@pytest.mark.parametrize(("corners", "mixed"), [(1, False), (3, True)])
def test_ctrl_c_while_the_mixture_is_sought_is_an_interruption(
    corners: int, mixed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sets of the policy without the budget are written by then, and the mixture as far as it is known."""

    def run(world: Any, choice: Any, *args: Any, **kwargs: Any) -> Any:
        found = run_solver(world, choice, *args, **kwargs)
        return replace(found, interrupted=next(counted) >= corners)

    counted = itertools.count(1)
    monkeypatch.setattr("trackmdp.solvers.frontier.run_solver", run)
    words = ["solve", "grid.size=4", f"hydra.run.dir={tmp_path}", "cost.mean_budget=0.7"]
    assert main(words) == 130
    without = json.loads((tmp_path / "solution.json").read_text(encoding="utf-8"))
    path = tmp_path / "mean_budget.json"
    assert path.is_file() == mixed
    # The bound on policies with any number of sensors holds as well.
    assert not mixed or json.loads(path.read_text(encoding="utf-8"))["upper"] <= without["upper"]
