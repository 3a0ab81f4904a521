"""Several targets with a window: it limits each one's own plan, together any sensors can be chosen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import trackmdp as tm
from tests.episodes import groups
from tests.solvers.test_group import check_bracket, tiny
from trackmdp.app.cli import main
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.several.merging import make_rule
from trackmdp.world.group import Group
from trackmdp.world.model import World


@pytest.mark.parametrize("seed", range(4))
def test_brute_force_over_all_sets_lies_in_the_bracket(seed: int) -> None:
    world = tiny(seed, t_max=seed % 2, window=seed // 2)
    check_bracket(Group([world, World.of(world, tiny(seed + 100).kernel) if seed % 2 else world]))


def test_bound_and_figures_are_those_of_the_same_sets_without_a_window() -> None:
    world = tm.make_world(
        "random_support", size=3, support_size=3, exit_probability=0.05, cost=0.2, t_max=1, seed=3
    )
    near, plain = (Group([world.but(window=each)] * 2) for each in (1, None))
    found = tm.solve(near)
    assert found.upper == pytest.approx(tm.solve(plain).upper, abs=1e-12)
    same = PolicyTable(world, found.tables[0].written)
    for merge in ("gains", "union"):
        mine, theirs = (make_rule(group, [same], merge) for group in (near, plain))
        one, other = (tm.evaluate(each.group, each, width=0.1) for each in (mine, theirs))
        np.testing.assert_array_equal(one.totals, other.totals)


def test_all_on_unites_the_windows_of_all_targets() -> None:
    group = Group([tm.make_world("random_walk", size=5, cost=0.2, window=1)] * 2)
    assert make_rule(group, [PolicyTable.all_on(group.single)]).name == "union"
    episode = tm.simulate(group, "all_on", 1)[0]
    assert episode.action[0].sum() <= 18


def test_environment_simulation_tracker_and_log_agree(tmp_path: Path) -> None:
    group = Group(
        [tm.make_world("random_walk", size=4, exit_probability=0.05, cost=0.2, t_max=1, window=1)]
        * 2
    )
    rule = tm.solve(group).policy
    episodes = tm.simulate(group, rule, 2)
    groups.check_steps(group, episodes, rule)
    assert tm.TrackEnv(group, 3).rollout(2, rule)["action"].shape == (3, 2, 16)
    for episode in episodes:
        assert len(list(groups.tracked(rule, episode))) == len(episode)
    with EpisodeReader(groups.write(tmp_path / "a.mcap", episodes.complete(), rule)) as reader:
        assert verify(reader).difference is None


@pytest.mark.slow
def test_plans_are_learned_in_the_window_and_merged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "a"
    words = [
        "targets.count=2",
        "grid.size=6",
        "grid.window=2",
        "evaluation.width=0.2",
        "log=[mcap]",
    ]
    assert main(["train", *words, "collector.total_frames=10000", f"hydra.run.dir={run}"]) == 0
    assert main(["evaluate", f"run={run}", f"hydra.run.dir={tmp_path / 'b'}"]) == 0
    assert "merged by gains" in capsys.readouterr().out
    assert main(["replay", f"file={run / 'episodes.mcap'}", "verify=true"]) == 0
