"""The environment of several targets: its specs, its rules, and the values that the solvers give its policies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

import trackmdp as tm
from tests.episodes.groups import check_steps
from tests.helpers import later
from tests.tracks import by_hand, recorded
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.render import LEGEND_OF_SEVERAL
from trackmdp.errors import UserError
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.several.merging import make_rule
from trackmdp.solvers.solve import solve
from trackmdp.world.group import Group
from trackmdp.world.model import World


def two_kinds(**options: object) -> Group:
    """A target that walks on 3 x 3 cells, and two that drift."""
    given = {"size": 3, "exit_probability": 0.1, "t_max": 1, "cost": 0.2} | options
    walks, drifts = (tm.make_world(name, **given) for name in ("random_walk", "drift"))  # type: ignore[call-overload]
    return Group([walks, drifts, drifts])


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_specs_hold(batch: tuple[int, ...]) -> None:
    env = TrackEnv(two_kinds(), batch)
    check_env_specs(env)
    shown = env.rollout(4, break_when_any_done=False)
    assert shown["present"].shape == (*batch, 4, 3)
    assert shown["action_history"].shape == (*batch, 4, 2, 9)
    assert env.target.shape == (*batch, 3)


def test_one_target_is_todays_environment() -> None:
    world = tm.make_world(size=3, targets=1)
    assert isinstance(world, World)
    assert "present" not in TrackEnv(world, 2).observation_spec


def test_a_step_is_rewarded_by_hand() -> None:
    env = TrackEnv(two_kinds(safe_cost=1.5), 200, seed=3)
    state, empty = env.reset(), torch.zeros(200, 9, dtype=torch.bool)
    action = torch.rand(200, 9, generator=torch.Generator().manual_seed(0)) < 0.3
    for step in range(3):
        on = empty if step == 1 else action
        before, forced = state, (state["steps_since_detection"] > 1).any(-1)
        state = env.step(state.set("action", on))["next"]
        inside = env.target < 9
        seen = inside & (on.gather(1, env.target.clamp_max(8)) | forced[:, None])
        paid = torch.where(forced, 1.5, 0.2 * on.sum(-1)) * inside.any(-1)
        torch.testing.assert_close(state["reward"][:, 0], (seen.sum(-1) - paid).float())
        n = torch.where(inside & ~seen, before["steps_since_detection"] + 1, 0)
        torch.testing.assert_close(state["steps_since_detection"], n)
        torch.testing.assert_close(state["present"], inside)
        kept = on & ~forced[:, None]
        torch.testing.assert_close(state["action_history"][:, 0], kept)
        torch.testing.assert_close(state["terminated"][:, 0], ~inside.any(-1))
        where = torch.where(seen, env.target.clamp_max(8), before["last_cell"])
        torch.testing.assert_close(state["last_cell"], where)


@pytest.mark.parametrize("merge", ["gains", "union"])
def test_a_rule_earns_in_the_environment_what_the_joint_chain_says(merge: str) -> None:
    group = Group([tm.make_world("random_walk", size=3, exit_probability=0.2, t_max=0)] * 2)
    rule = make_rule(group, solve(group).tables, merge)
    exact = evaluate(group, rule)
    assert exact.exact
    rewards, ends = torch.zeros(500, 1), 0
    for shown in Collector(
        TrackEnv(group, 500, seed=1), rule, frames_per_batch=50_000, total_frames=200_000
    ):
        rewards += shown["next", "reward"].sum(1)
        ends += int(shown["next", "done"].sum())
    # In the long run episodes follow each other, so that rewards per step are AIHTR / length.
    each = rewards.numpy() / 400
    error = each.std() / np.sqrt(len(each))
    assert 400 * 500 / ends == pytest.approx(group.expected_steps, rel=0.02)
    expected = exact.aihtr.mean / group.expected_steps
    assert each.mean() == pytest.approx(expected, abs=4 * error)
    assert error < 0.02 * abs(expected)


# The second track enters when the first has made two steps, or has left.
LATER = replace(by_hand([0, 1, 2, 1, 0, 3], [3, 4, 7, 8, 5, 2]), begins=np.array([0, 2]))
ACTED = {
    "three": two_kinds(t_max=2, cost=0.4, detection=0.7),
    "footprints": two_kinds().but(coverage=np.tri(9, 9, 1), cost=0.3, safe_cost=2.0),
    "no sensor": two_kinds(cost=np.where(np.arange(9) == 3, np.nan, 0.3), safe_cost=2.0),
    "recorded": Group.of_tracks(recorded(LATER, t_max=2), 2),
}


@pytest.mark.parametrize(
    ("name", "merge"),
    [
        *zip(ACTED, ("gains", "union") * 2, strict=True),
        *later(zip(ACTED, ("union", "gains") * 2, strict=True)),
    ],
)
def test_a_rule_acts_on_what_is_shown_as_the_simulation_does(name: str, merge: str) -> None:
    group = ACTED[name]
    rule = make_rule(group, [solve(each).table for each in group.kinds], merge)
    check_steps(group, tm.simulate(group, rule, 30), rule)


@pytest.mark.parametrize("max_steps", [None, 6])
def test_simulated_steps_are_those_of_the_environment_to_the_bit(max_steps: int | None) -> None:
    group = two_kinds(detection=0.7, safe_detection=0.6, safe_cost=1.5, max_steps=max_steps)
    check_steps(group, tm.simulate(group, "none", 6))


def test_a_safe_action_that_misses_is_repeated() -> None:
    env = TrackEnv(
        two_kinds(safe_detection=0.4, safe_cost=1.5, exit_probability=0.01), 3000, seed=5
    )
    check_env_specs(env)
    state, none = env.reset(), torch.zeros(3000, 9, dtype=torch.bool)
    for step in range(4):
        before, forced = state["steps_since_detection"], state["steps_since_detection"].amax(-1) > 1
        state = env.step(state.set("action", none))["next"]
        assert bool(forced.all()) == (step == 2)
        n, inside = state["steps_since_detection"], state["present"]
        missed = inside & (n > 0)
        torch.testing.assert_close(n[missed], (before + 1).clamp_max(2)[missed])
        paid = 1.5 * forced * inside.any(-1)
        located = (inside & (n == 0)).sum(-1)
        torch.testing.assert_close(state["reward"][:, 0], (located - paid).float())
        found = located.sum() / inside.sum()
        if step == 2:
            assert abs(float(found) - 0.4) < 0.02
        elif step < 2:
            assert found == 0
    # Where one clock of three stands at 2 all targets are looked for once more.
    assert abs(float(forced.float().mean()) - (1 - 0.4**3)) < 0.02


def test_where_there_is_no_sensor_none_reports_although_it_is_switched_on() -> None:
    cost = np.full(9, 0.1)
    cost[3] = np.nan
    env = TrackEnv(two_kinds(cost=cost), 200)
    state = env.reset()
    for _ in range(3):
        forced = state["steps_since_detection"].amax(-1, keepdim=True) > 1
        state = env.step(state.set("action", torch.ones(200, 9, dtype=torch.bool)))["next"]
        there = (env.target == 3) & ~forced
        assert there.any()
        assert (state["steps_since_detection"][there] > 0).all()
        # Nor is it remembered: a rule for several targets is valued by the sensors that are on.
        assert not state["action_history"][..., 3].any()


def test_episodes_are_cut_after_the_last_step_allowed() -> None:
    env = TrackEnv(two_kinds(max_steps=3, exit_probability=0.3), 500, seed=1)
    check_env_specs(env)
    shown = env.rollout(3, break_when_any_done=False)["next"]
    assert shown["step_count"].max() == 3
    ended = shown["done"][:, :, 0].numpy()
    truncated, left = shown["truncated"][:, :, 0], ~shown["present"].any(-1)
    assert (truncated[:, :2].sum(), bool(truncated[:, 2].any())) == (0, True)
    assert (shown["terminated"][:, :, 0] == left).all()
    assert (ended == (truncated | left).numpy()).all()


def test_a_snapshot_continues_with_the_same_draws() -> None:
    env = TrackEnv(two_kinds(detection=0.7), 4)
    env.rollout(5, break_when_any_done=False)
    kept = env.snapshot()
    action = torch.ones(4, 9, dtype=torch.bool)
    first = env.step(env.restore(kept).set("action", action))
    again = env.step(env.restore(kept).set("action", action))
    assert (first == again).all()
    with pytest.raises(UserError, match="snapshot: expected one of TrackEnv"):
        TrackEnv(two_kinds(), 5).restore(kept)


def test_its_picture_shows_all_targets() -> None:
    """Targets that stay in cells 1 and 2 of 2 x 2: at first, one missed, the safe action, one that has left."""
    env = TrackEnv(Group([World(np.eye(4), 2, cost=0.1, t_max=0, max_steps=9)] * 2), 2)
    env.reset()
    there = env.snapshot()
    there["rows"] |= dict.fromkeys(("place", "last_cell"), torch.tensor([[0, 0], [1, 2]]))
    state, pictures = env.restore(there), [env.render("text", 1)]
    for cells in ([0, 1], [3]):
        action = torch.isin(torch.arange(4), torch.tensor(cells)).expand(2, 4)
        state = env.step(state.set("action", action))["next"].select(*env.observation_spec)
        pictures.append(env.render("text", 1))
    there = env.snapshot()
    there["rows"]["place"] = torch.tensor([[0, 0], [4, 2]])
    env.restore(there)
    pictures.append(env.render("text", 1))
    assert [each.splitlines()[:2] for each in pictures] == [
        ["· ⓿", "❶ ·"],
        ["▪ ⓿", "① ·"],
        ["▪ ⓿", "❶ ▪"],
        ["· ·", "❶ ·"],
    ]
    assert pictures[0].endswith(LEGEND_OF_SEVERAL)
    pixels = env.render(row=1)
    assert not isinstance(pixels, str)
    assert (pixels[17:31, 1:15] == (0, 90, 181)).all()


def test_what_several_targets_do_not_have_is_refused() -> None:
    group = two_kinds(budget=1)
    env = TrackEnv(group, 2)
    assert int(env.rollout(9, break_when_any_done=False)["action"].sum(-1).max()) <= 1
    with pytest.raises(UserError, match="5 sensors on, expected at most the budget, 1"):
        env.step(env.reset().set("action", torch.arange(18).view(2, 9) % 2 == 0))


@pytest.mark.usefixtures("little_search")
@pytest.mark.parametrize(
    ("acted", "shown", "message"),
    [
        (two_kinds(safe_detection=0.9), None, "reads the steps in which the safe action missed"),
        (
            tm.make_world("heading", size=2, memory="displacement", targets=2),
            None,
            "reads the keys",
        ),
        (two_kinds(), Group(two_kinds().worlds[:2]), "expected last_cell, .* of 3 targets"),
        (two_kinds(), two_kinds().single, "expected last_cell, .* of 3 targets"),
    ],
)
def test_a_rule_refuses_states_that_do_not_show_all_that_it_reads(
    acted: Group, shown: Group | World | None, message: str
) -> None:
    rule = solve(acted).policy
    with pytest.raises(UserError, match=f"^policy: {message}"):
        TrackEnv(shown or acted, 2).rollout(3, rule)
