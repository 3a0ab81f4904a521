"""Recorded tracks that several targets follow at the same time: at their own times, by hand, alike everywhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import trackmdp as tm
from tests.helpers import later
from tests.tracks import by_hand, recorded, write
from trackmdp.app.cli import main
from trackmdp.environment.env import TrackEnv
from trackmdp.episodes.group_episodes import GroupEpisodes
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.errors import UserError
from trackmdp.recordings.together import Together
from trackmdp.recordings.tracks import Recorded, Tracks
from trackmdp.solvers.evaluate import evaluate, group_rule
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.merging import make_rule
from trackmdp.training.evaluator import estimated_qmdp
from trackmdp.world.group import Group
from trackmdp.world.problem_file import problem_bytes, problem_digest, read_problem

CITY = ("kernel=tracks", "kernel.path=tests/data/city.csv", "kernel.step=5", "grid.cell=50")


def at_times(begins: Sequence[int], *tracks: Sequence[int], exits: Any = True) -> Tracks:
    return replace(by_hand(*tracks, exits=exits), begins=np.array(begins))


def group(tracks: Tracks, count: int = 2, **more: Any) -> Group:
    return Group.of_tracks(recorded(tracks, **more), count)


# Steps 0 1 2 3 4 5: track 0 is there at 0 1 2 and leaves, 1 at 1 2 3 and leaves, 2 at 5 6.
APART = at_times([0, 1, 5], [0, 1, 2], [3, 4, 5], [6, 7])


def test_tracks_are_together_where_their_times_overlap() -> None:
    together = Together(APART, 2)
    assert [together.overlapping(k).tolist() for k in range(3)] == [[1], [0], []]
    assert sorted(map(sorted, together.groups.tolist())) == [[-1, 2], [0, 1]]
    touching = Together(at_times([0, 3], [0, 1, 2], [3, 4]), 2)
    assert touching.overlapping(0).size == touching.overlapping(1).size == 0
    # Without times all begin at once, and each is in one group.
    alike = Together(by_hand([0], [1], [2], [3, 4], [5]), 2).groups
    assert sorted(alike[alike >= 0].tolist()) == [0, 1, 2, 3, 4]
    assert len(alike) == 3


def test_random_tracks_are_each_in_one_group_with_a_leader_that_all_overlap() -> None:
    rng = np.random.default_rng(3)
    lengths = rng.integers(1, 9, size=200)
    tracks = at_times(rng.integers(0, 300, size=200), *([0] * each for each in lengths))
    together = Together(tracks, 4)
    found = together.groups
    assert sorted(found[found >= 0].tolist()) == list(range(200))
    for each in found:
        others = set(each[1:][each[1:] >= 0].tolist())
        assert others <= set(together.overlapping(each[0]).tolist())
    places = together.places(found)
    # The leader is there at the start, each other one in so many steps as it begins later.
    points, first = len(tracks.cells), tracks.first[found[:, 0]]
    np.testing.assert_array_equal(places[:, 0], first)
    assert tracks.begins is not None
    late = np.where(found >= 0, tracks.begins[found] - tracks.begins[found[:, :1]], 0)
    expected = np.where(found >= 0, tracks.first[found] - late * points, points)
    np.testing.assert_array_equal(places, expected)


def test_figures_by_hand() -> None:
    """All on, r = 1, c = .2: 9 sensors cost 1.8 in every step in which a target is in the grid."""
    found = evaluate(group(APART), "all_on")
    # 0 and 1 together: in step 1 target 0 is seen (that in which 1 enters is none of its own), in step 2 both, in step
    # 3 target 1 alone, and step 4 is its exit. Of 2 alone: one step, and the exit.
    rows = sorted(found.totals[:, :6].tolist())
    assert rows[0] == pytest.approx([1 + 2 + 1 - 3 * 1.8, 4, 4, 27, 0, 4])
    assert rows[1] == pytest.approx([1 - 1.8, 1, 1, 9, 0, 2])
    assert found.expected_length == 3.0
    assert found.accuracy.mean == 1.0
    assert found.reward_per_step.mean == pytest.approx((4 - 5.4 + 1 - 1.8) / 6)


def test_a_track_that_is_cut_counts_to_its_end() -> None:
    # Track 0 stops at its third cell; 1 goes on for two more steps, the last of them its exit.
    tracks = at_times([0, 0], [0, 1, 2], [3, 4, 5, 5], exits=[False, True])
    found = evaluate(group(tracks), "all_on").totals[0]
    assert found[:6] == pytest.approx([2 + 2 + 1 - 3 * 1.8, 5, 5, 27, 0, 4])
    # Both stop: the episode ends with the later one, with no step more.
    both = at_times([0, 0], [0, 1, 2], [3, 4, 5, 5], exits=False)
    assert evaluate(group(both), "all_on").totals[0, 5] == 3
    (episode,) = tm.simulate(group(both), "all_on", 1)
    assert episode.truncated
    assert not episode.terminated
    assert len(episode) == 3


@pytest.mark.parametrize("exits", [True, False])
def test_one_target_is_todays_recording(exits: bool) -> None:
    rng = np.random.default_rng(0)
    tracks = by_hand(*(rng.integers(9, size=rng.integers(4, 9)) for _ in range(12)), exits=exits)
    setting = recorded(tracks)
    for name in ("none", "all_on"):
        alone, one = evaluate(setting, name), evaluate(Group.of_tracks(setting, 1), name)
        assert one.aihtr.mean == pytest.approx(alone.aihtr)
        assert one.expected_length == pytest.approx(alone.expected_length)
        assert one.accuracy.mean == pytest.approx(alone.accuracy)
        # Of one target per step in the grid.
        sensors = one.totals[:, 3].sum() / one.totals[:, 1].sum()
        assert sensors == pytest.approx(alone.sensors_per_step)


def several(count: int, **more: Any) -> Group:
    """Random tracks with times, some of which are cut."""
    rng = np.random.default_rng(1)
    tracks = at_times(
        rng.integers(0, 40, size=30),
        *(rng.integers(9, size=rng.integers(4, 9)) for _ in range(30)),
        exits=rng.random(30) < 0.5,
    )
    return group(tracks, count, **more)


@pytest.mark.parametrize("merge", ["gains", "union"])
def test_episodes_earn_what_the_figures_say(merge: str) -> None:
    targets = several(3)
    rule = make_rule(targets, [evaluate_table(targets)], merge)
    found = evaluate_group(rule)
    # Every group of held-out tracks turns up among many episodes.
    episodes = tm.simulate(targets, rule, 200)
    assert isinstance(episodes, GroupEpisodes)
    assert episodes.figures().about == "200 simulated episodes along held-out tracks, 95 %"
    played = {tuple(np.round(episodes._totals(each)[:6], 3).tolist()) for each in episodes}
    assert played == {tuple(row) for row in np.round(found.totals[:, :6], 3).tolist()}


def evaluate_table(targets: Group) -> Any:
    """Sensors 0 ... 4 on after a detection, the others after a miss."""
    sets = np.zeros((9, 2, 9), dtype=bool)
    sets[:, 0, :5] = sets[:, 1, 5:] = True
    return group_rule(targets, sets).tables[0]


@pytest.mark.parametrize("count", [1, 3])
def test_the_environment_follows_the_tracks(count: int) -> None:
    targets = several(count, anywhere=True) if count == 3 else several(count)
    check_env_specs(TrackEnv(targets, 4))
    env = TrackEnv(targets, 16, seed=2)
    assert targets.recorded is not None
    tracks = targets.recorded.tracks
    moves = set(zip(*map(np.ndarray.tolist, tracks.steps(9)), strict=True))
    # A recording that stops is known to have done so one step later.
    moves |= {(int(tracks.cells[last - 1]), 9) for last in tracks.first[1:][~tracks.exits]}
    came: torch.Tensor | None = None
    state, entered, cut = env.reset(), 0, 0
    for _ in range(60):
        before, was = env.target.clone(), state["present"]
        assert (before < 9).equal(was)
        action = torch.rand(16, 9) < 0.4
        after = env.step(state.set("action", action))["next"]
        now, present = env.target, after["present"]
        seen = now.clamp_max(8)
        new = present & ~was
        entered += int(new.sum())
        assert {(int(a), int(b)) for a, b in zip(before[was], now[was], strict=True)} <= moves
        # A target that enters is located; where it will enter is not shown before.
        assert (after["last_cell"][new] == now[new]).all()
        assert (after["steps_since_detection"][new] == 0).all()
        came = was if came is None else came | was
        assert (state["last_cell"][~came] == 0).all()
        forced = (state["steps_since_detection"] > 1).any(-1, keepdim=True)
        here = was & present
        found = here & (action.gather(1, seen) | forced)
        paid = torch.where(forced[:, 0], 1.8, 0.2 * action.sum(-1)) * here.any(-1)
        torch.testing.assert_close(after["reward"][:, 0], (found.sum(-1) - paid).float())
        cut += int(after["truncated"].sum())
        assert not (after["terminated"] & present.any(-1, keepdim=True)).any()
        state = after
        if after["done"].any():
            state = env.reset(after.set("_reset", after["done"]))
            came &= ~after["done"]
    assert cut
    assert entered or count == 1


def test_a_snapshot_continues_with_the_same_tracks() -> None:
    env = TrackEnv(several(2), 8, seed=1)
    env.rollout(7, break_when_any_done=False)
    kept = env.snapshot()
    shown = []
    for _ in range(2):
        env.restore(kept)
        env._tracking.begin(torch.ones(8, 1, dtype=torch.bool))
        shown.append(env.target)
    assert shown[0].equal(shown[1])


def test_unions_are_the_default_but_with_a_budget() -> None:
    few, many = several(2, budget=1), several(2)
    assert group_rule(many, estimated_qmdp(many.single)).name == "union"
    assert group_rule(few, estimated_qmdp(few.single)).name == "gains"
    world = tm.make_world("random_walk", size=3)
    assert group_rule(Group([world] * 2), "qmdp").name == "gains"
    assert 0 < evaluate(few, estimated_qmdp(few.single)).sensors_per_step.mean <= 1
    assert group_rule(few, "none", "union").name == "union"  # as a log of it says


@pytest.mark.parametrize("targets", [several(2, budget=1), Group([tm.make_world(size=3)] * 2)])
def test_no_sensor_is_on_where_none_is_asked_for(targets: Group) -> None:
    """Gains would switch some on: a miss is worth less where the sensors of no plan find the target again."""
    assert evaluate(targets, "none").sensors_per_step.mean == 0
    (episode, *_) = tm.simulate(targets, "none", 2)
    assert not episode.action.any()


def test_all_sensors_are_on_where_all_are_asked_for() -> None:
    targets = Group([tm.make_world(size=3)] * 2)
    assert all(each.action.all() for each in tm.simulate(targets, "all_on", 3))


def test_targets_may_come_from_where_no_move_is_known() -> None:
    unknown = recorded(by_hand([0, 1]), by_hand([6, 7]))
    episodes = tm.simulate(Group.of_tracks(unknown, 1), "none", 2).complete()
    assert [each.belief.nnz for each in episodes] == [0, 0]


def test_moves_are_pooled_by_cell() -> None:
    kernel = by_hand([0, 1, 2], [0, 1], [0, 0]).kernel(9).toarray()
    # Of cell 0: to 1 twice, to 0, the exit, and one exit more.
    np.testing.assert_allclose(kernel[0, :3], [0.2, 0.4, 0.0])
    np.testing.assert_allclose(kernel[1, :3], [0.0, 0.0, 1 / 3])
    assert not kernel[3:].any()


@pytest.mark.parametrize("merge", ["union", *later(["gains"])])
def test_a_log_verifies_to_the_bit(merge: str, tmp_path: Path) -> None:
    words = [*CITY, "grid.size=[18,15]", "targets.count=3", f"targets.merge={merge}", "quiet=true"]
    more = ["baseline=none", "log=[mcap]", "episodes=6", f"hydra.run.dir={tmp_path}"]
    assert main(["evaluate", *words, *more]) == 0
    with EpisodeReader(tmp_path / "episodes.mcap") as reader:
        assert verify(reader).difference is None
        world = reader.world()
        steps = reader[0]
        assert (steps["present"] == (reader.read(0).to_tensordict(world.task)["present"])).all()
    page = ["replay", f"file={tmp_path / 'episodes.mcap'}", f"html={tmp_path / 'a.html'}"]
    assert main([*page, "quiet=true"]) == 0
    assert "along held-out tracks" in (tmp_path / "a.html").read_text(encoding="utf-8")


def test_a_recorded_group_is_read_back(tmp_path: Path) -> None:
    targets = several(3)
    (tmp_path / "a.npz").write_bytes(problem_bytes(targets))
    again = read_problem(tmp_path / "a.npz")
    assert isinstance(again, Group)
    assert problem_digest(again) == problem_digest(targets)
    assert evaluate(again, "none").aihtr == evaluate(targets, "none").aihtr


@pytest.mark.parametrize(
    ("memory", "window"),
    [("cell", "null"), pytest.param("displacement", 1, marks=pytest.mark.slow)],
)
def test_a_plan_is_learned_and_its_sets_united(memory: str, window: Any, tmp_path: Path) -> None:
    words = ["kernel=tracks", f"kernel.path={write(tmp_path / 'a.csv', APART30)}", "grid.size=3"]
    words += [f"task.memory={memory}", f"grid.window={window}"]
    few = ["algo.total_frames=2000", "algo.frames_per_batch=1000", "quiet=true"]
    run = tmp_path / "run"
    assert main(["train", *words, *few, "targets.count=2", f"hydra.run.dir={run}"]) == 0
    loaded = tm.load_run(run)
    several = loaded.summary["several"]
    problem = read_problem(run / "problem.npz")
    assert isinstance(problem, Recorded)
    found = evaluate(Group.of_tracks(problem, 2), loaded.policy)
    assert several["figures"]["aihtr"]["mean"] == found.aihtr.mean
    assert several["merge"] == "union"
    assert several["upper"] is None


@pytest.mark.parametrize("algo", ["a2c", "dqn"])
def test_nets_learn_of_all_tracks_together(algo: str, tmp_path: Path) -> None:
    targets = several(2)
    few = {"total_frames": 512, "frames_per_batch": 256, "envs": 32, "hidden": 8}
    run = tm.train(targets, algo, folder=tmp_path / algo, **few)
    assert run.several is not None
    assert [row[0] for row in run.several.rows("learned")] == ["learned", "all on", "no sensors"]
    again = evaluate(targets, tm.load_run(tmp_path / algo))
    assert again.aihtr.mean == run.several.figures.aihtr.mean == run.evaluation.aihtr


def test_policies_are_compared_over_groups_of_held_out_tracks() -> None:
    targets = several(2)
    compared = tm.compare(targets, ["none", "all_on", "qmdp"])
    found = [evaluate(targets, name).totals[:, 0] for name in ("none", "all_on")]
    assert compared.about == f"{len(found[0])} groups of held-out tracks"
    assert compared.policies[1].difference.mean == pytest.approx((found[1] - found[0]).mean())
    assert "per group than none; 95 %" in compared.sentences[0]


def test_tracks_of_several_targets_from_a_file(tmp_path: Path) -> None:
    file = write(tmp_path / "a.csv", APART30)
    targets = tm.load_tracks(file, 3, targets=2)
    assert isinstance(targets, Group)
    assert len(targets) == 2
    alone = tm.load_tracks(file, 3)
    assert isinstance(alone, Recorded)
    for wrong in (0, 1001, "x", 1.5, np.array([1, 2])):
        with pytest.raises(UserError, match=r"^targets=.*: expected an integer from 1 to 1"):
            tm.load_tracks(file, 3, targets=wrong)  # type: ignore[call-overload]
        with pytest.raises(UserError, match=r"^targets=.*: expected an integer from 1 to 1"):
            tm.make_world(targets=wrong)
    remembering = tm.load_tracks(file, 3, targets=2, memory="displacement")
    assert evaluate(remembering, "none").aihtr == evaluate(targets, "none").aihtr
    with pytest.raises(UserError, match=r"task.memory=displacement: expected cell"):
        tm.load_tracks(file, 3, targets=2, memory="displacement", budget=1)
    with pytest.raises(UserError, match=r"task.memory=displacement: expected cell"):
        tm.train(remembering, "a2c")
    with pytest.raises(UserError, match=r"solver=optimal: needs a motion model"):
        tm.solve(targets)
    budgeted = tm.load_tracks(file, 3, targets=2, budget=1)
    assert isinstance(budgeted, Group)
    assert budgeted.task.budget == 1


APART30 = by_hand(*(np.random.default_rng(k).integers(9, size=6).tolist() for k in range(30)))


@pytest.mark.parametrize("count", [0, 1.5, "2", 10**9])
def test_a_wrong_number_of_targets_is_refused(count: Any) -> None:
    setting = recorded(by_hand([0, 1, 2], [2, 1, 0]))
    with pytest.raises(UserError, match=f"count={count!r}: expected an integer from 1 to 1,000"):
        Group.of_tracks(setting, count)


def test_more_targets_than_tracks_are_refused_before_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of 30 tracks 6 are held out, 3 to choose by, and 21 to learn from."""
    file = write(tmp_path / "a.csv", APART30)
    folder = tmp_path / "run"
    words = ["kernel=tracks", f"kernel.path={file}", "grid.size=3", f"hydra.run.dir={folder}"]
    for more, most in (
        (["targets.count=7"], "6, the number of tracks held out (kernel.held_out)"),
        (
            ["targets.count=4", "algo=a2c"],
            "3, the number of tracks to choose by (kernel.validation)",
        ),
        (
            ["targets.count=4", "algo=a2c", "kernel.held_out=0.8"],
            "3, the number of tracks to learn from",
        ),
    ):
        assert main(["train", *words, *more]) == 2
        assert capsys.readouterr().err == f"trackmdp train: {more[0]}: expected at most {most}\n"
        assert not folder.exists()
    with pytest.raises(UserError, match=r"targets\.count=7: expected at most 6, .* held out"):
        tm.load_tracks(file, 3, targets=7)
    assert len(tm.load_tracks(file, 3, targets=6)) == 6
    assert main(["evaluate", *words, "baseline=none", "targets.count=7"]) == 2


def test_95_percent_are_named_where_an_interval_is_shown() -> None:
    few, many = (evaluate(group(by_hand(*[[0, 1, 2], [1, 2]] * k)), "none") for k in (1, 8))
    assert few.about == "1 group of held-out tracks"
    assert many.about == "8 groups of held-out tracks, 95 %"


def test_a_world_has_no_tracks_to_be_followed_together() -> None:
    with pytest.raises(UserError, match="a World, expected Recorded"):
        Group.of_tracks(tm.make_world(size=3), 2)  # type: ignore[arg-type]
