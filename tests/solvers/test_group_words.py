"""Several targets: words and policies that do not fit, and the commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.solvers.test_group import tiny
from trackmdp.app.cli import main
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.several import group_value
from trackmdp.solvers.several.merging import make_rule
from trackmdp.world.group import Group
from trackmdp.world.model import World


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        (
            ["train", "algo=ppo", "targets.count=2", "grid.window=2"],
            "grid.window=2: expected null with algo=ppo with targets.count=2",
        ),
        (
            ["train", "algo=ppo", "targets.count=2", "kernel=heading", "kernel.reveals=true"],
            "kernel.reveals=True: expected false",
        ),
        (
            ["solve", "targets.count=2", "kernel=heading", "cost.budget=2"],
            "cost.budget=2: expected null with hidden modes",
        ),
        (
            ["evaluate", "baseline=none", "targets.count=2", "sensor=false_alarm"],
            "sensor=false_alarm: expected perfect, miss or footprint",
        ),
        (["solve", "targets.count=2", "cost.mean_budget=1"], "cost.mean_budget=1"),
        (
            ["evaluate", "baseline=qmdp", "targets.count=2", "episodes=5"],
            "episodes=5: without effect",
        ),
        (["evaluate", "baseline=qmdp", "evaluation.width=1"], "without effect"),
    ],
)
def test_words_without_effect_are_refused(
    words: list[str], refusal: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main([*words, f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert refusal in capsys.readouterr().err


@pytest.mark.parametrize("width", [0, -1, float("nan"), float("inf"), "x", None])
def test_a_width_that_no_interval_has_is_refused(width: Any) -> None:
    with pytest.raises(UserError, match=f"width={width}: expected a number > 0"):
        evaluate(Group([tiny(0)] * 2), "none", width=width)


def test_a_seed_is_checked_where_the_figures_are_exact() -> None:
    with pytest.raises(UserError, match=r"seed=1\.5: expected an integer"):
        evaluate(Group([tiny(0)] * 2), "none", seed=1.5)


def test_a_width_may_be_any_real_number() -> None:
    assert evaluate(Group([tiny(0)] * 2), "none", width=np.float32(0.5)).exact


def test_a_width_that_is_never_reached_ends_at_the_most_episodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(group_value, "_MOST", 100)
    world = tm.make_world("random_walk", size=4, exit_probability=0.2)
    assert len(evaluate(Group([world] * 3), "qmdp", width=5e-324).totals) == 100


def test_networks_have_one_thread_meanwhile_and_the_process_its_own_again() -> None:
    world, seen = tiny(0), set[int]()

    def nothing(cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        seen.add(torch.get_num_threads())
        return torch.zeros(len(cell), 3, dtype=torch.bool)

    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        evaluate(Group([world] * 2), nothing, width=1.0)
        assert (seen, torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(before)


def test_other_targets_and_policies_are_refused() -> None:
    world = tiny(0)
    for many in (None, 5, world, [], [None], [world] * 1001):
        with pytest.raises(UserError, match="Group: expected a list of 1 to 1,000 times a World"):
            Group(many)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="target 1 has another grid, price or limit"):
        Group([world, world.but(t_max=1)])
    with pytest.raises(UserError, match="window=1: expected null with algo=ppo"):
        tm.train(Group([world.but(window=1)] * 2), "ppo")
    with pytest.raises(UserError, match="does not draw, for several targets"):
        evaluate(Group([world] * 2), Policy.random_k(world, 1))
    with pytest.raises(UserError, match="merge: an option of several targets"):
        evaluate(world, "none", merge="gains")  # type: ignore[call-overload]
    with pytest.raises(UserError, match="expected gains with a budget"):
        evaluate(Group([world.but(budget=1)] * 2), "qmdp", merge="union")


def test_plans_go_with_their_motions_to_other_targets() -> None:
    one, other = tiny(1), World.of(tiny(1), tiny(2).kernel)
    both = Group([one, other])
    found, alone = tm.solve(both), tm.solve(Group([one]))
    own = dict(zip(both.kinds, found.tables, strict=True))
    for worlds in ([other, one], [one, one], [other]):
        targets = Group(worlds)
        for merge in ("gains", "union"):
            rule = make_rule(targets, [own[kind] for kind in targets.kinds], merge)
            for policy in (found, found.policy):
                mine = evaluate(targets, policy, merge=merge)
                assert mine.aihtr == evaluate(targets, rule).aihtr
    with pytest.raises(UserError, match="policy: number of plans 1, expected 2"):
        evaluate(both, alone)
    for call in (tm.evaluate, lambda *given: tm.simulate(*given, 2)):
        with pytest.raises(UserError, match="policy: for 2 targets, expected one for a single"):
            call(one, found.policy)


def test_commands_solve_and_evaluate_with_several_targets(tmp_path: Path) -> None:
    words = ["grid.size=3", "grid.t_max=0", "targets.count=2", "quiet=true"]
    assert main(["solve", *words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    solved = json.loads((tmp_path / "a" / "solution.json").read_text(encoding="utf-8"))
    more = ["baseline=optimal", f"hydra.run.dir={tmp_path / 'b'}"]
    assert main(["evaluate", *words, *more]) == 0
    valued = json.loads((tmp_path / "b" / "evaluation.json").read_text(encoding="utf-8"))
    assert solved["lower"] <= valued["figures"]["aihtr"]["mean"] <= solved["upper"]
    assert valued["exact"] is True


def test_gains_of_targets_that_never_exit_point_to_the_union() -> None:
    """Two targets on two cells; all sensors, for .6 a step, earn 2."""
    world = World(np.full((2, 2), 0.5), (1, 2), cost=0.3, t_max=1, max_steps=10)
    group = Group([world] * 2)
    with pytest.raises(UserError, match=r"never exits.*, or max_steps and targets.merge=union$"):
        tm.evaluate(group, "all_on", merge="gains")
    assert tm.evaluate(group, "all_on", merge="union").aihtr.mean == pytest.approx(14)
