"""Learning for several targets: together by one network, or one target's plan that is merged."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

import trackmdp as tm
from tests.helpers import later
from tests.training.runs import assert_same_run, at_iteration, train
from trackmdp.app.cli import main
from trackmdp.config import load_run_config
from trackmdp.environment.env import TrackEnv
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.errors import Preempted, UserError
from trackmdp.seeding import derive
from trackmdp.solvers.evaluate import evaluate, group_rule
from trackmdp.solvers.several.group_tracker import GroupTracker
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.joint_rule import JointRule
from trackmdp.solvers.several.merging import make_rule
from trackmdp.solvers.solve import solve
from trackmdp.training.group_run import joint_policy
from trackmdp.training.inputs import problem_of
from trackmdp.world.group import Group
from trackmdp.world.problem_file import problem_digest

WALKS = ("targets.count=2", "kernel=random_walk", "kernel.exit_probability=0.2")
FEW = {"total_frames": 512, "frames_per_batch": 256, "envs": 32, "hidden": 8}
BRIEF: dict[str, Any] = {"evaluation.width": 0.2, "optimal.enabled": False}


def group(**options: Any) -> Group:
    given = {"size": 3, "exit_probability": 0.2, "targets": 2} | options
    return tm.make_world("random_walk", **given)


@pytest.mark.parametrize("algo", ["a2c", pytest.param("ppo", marks=pytest.mark.slow), "dqn"])
def test_a_run_that_is_cut_goes_on_as_one_that_was_not(
    algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*WALKS, "evaluation.width=1", "collector.total_frames=1024")
    train(tmp_path / "whole", *words, algo=algo)
    with monkeypatch.context() as patch, pytest.raises(Preempted):
        at_iteration(patch, 2, lambda: signal.raise_signal(signal.SIGTERM))
        train(tmp_path / "cut", *words, algo=algo)
    train(tmp_path / "cut", *words, "resume=auto", algo=algo)
    assert_same_run(tmp_path / "whole", tmp_path / "cut")
    names = ("policy.npz", "problem.npz")
    for name in names:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "cut" / name).read_bytes()


def test_a_loaded_run_acts_and_is_valued_as_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tm.train(group(), "a2c", folder=tmp_path / "a", **FEW, **BRIEF)
    loaded = tm.load_run(tmp_path / "a")
    again = evaluate(group(), loaded, width=0.2)
    assert again.aihtr.mean == run.evaluation.aihtr == loaded.evaluation.aihtr
    assert run.summary["several"]["figures"]["aihtr"]["mean"] == again.aihtr.mean
    words = ["evaluate", f"run={tmp_path / 'a'}", "evaluation.width=0.2"]
    assert main(words) == 0
    assert ", 2 targets, learned together" in capsys.readouterr().out
    written = json.loads((tmp_path / "a" / "evaluation.json").read_text(encoding="utf-8"))
    assert written["figures"]["aihtr"]["mean"] == again.aihtr.mean
    assert written["merge"] == "joint"


def test_a_log_says_that_all_targets_are_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which may take minutes after `0 s left`."""
    few = [f"algo.{name}={value}" for name, value in FEW.items()]
    words = [*WALKS, "algo=a2c", *few, "optimal.enabled=false", "evaluation.width=0.2"]
    assert main(["train", "grid.size=3", *words, f"hydra.run.dir={tmp_path / 'a'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "100 %" in lines[lines.index("simulating all targets") - 1]


def test_the_group_is_in_the_runs_folder(tmp_path: Path) -> None:
    world = tm.make_world("random_walk", size=3, exit_probability=0.2, cost=0.1)
    other = tm.make_world("drift", size=3, exit_probability=0.3, cost=0.1)
    mixed = Group([other, world, other])
    tm.train(mixed, "a2c", folder=tmp_path, **FEW, **BRIEF)
    found = problem_of(load_run_config(tmp_path), tmp_path)
    assert isinstance(found, Group)
    assert found.targets == (0, 1, 0)
    assert problem_digest(found) == problem_digest(mixed) != problem_digest(group())
    np.testing.assert_array_equal(found.kernel.toarray(), mixed.kernel.toarray())


def test_the_environment_pays_what_the_figures_say() -> None:
    targets = group(budget=2, detection=0.8)
    run = tm.train(targets, "a2c", **FEW, **BRIEF)
    rule = group_rule(targets, run)
    assert isinstance(rule, JointRule)
    found = evaluate_group(rule, width=0.03)
    env = TrackEnv(targets, 2000, seed=derive(3, "test"))
    state, total, alive = env.reset(), np.zeros(2000), np.ones(2000, dtype=bool)
    while alive.any():
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            state = rule.actor(state)
        shown = env.step(state)["next"]
        assert int(state["action"].sum(-1).max()) <= 2
        total += shown["reward"][:, 0].numpy() * alive
        alive &= ~shown["terminated"][:, 0].numpy()
        state = shown.select(*env.observation_spec.keys())
    error = total.std() / np.sqrt(len(total))
    assert found.aihtr.high is not None
    assert abs(total.mean() - found.aihtr.mean) < 4 * error + found.aihtr.high - found.aihtr.mean


class Alternating(TensorDictModuleBase):
    """All sensors on after a step with none, and none after one with all."""

    in_keys = ("action_history",)
    out_keys = ("action",)

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        return state.set("action", ~state["action_history"][:, 0])


def test_a_network_is_shown_the_last_sets_in_simulations_and_by_a_tracker() -> None:
    rule = JointRule(group(), Alternating(), torch.device("cpu"))
    totals = evaluate_group(rule, episodes=30).totals
    # The last step, in which nothing is paid, is the exit: of L steps every second one of L - 1 has all sensors on.
    np.testing.assert_array_equal(totals[:, 3], 9 * (totals[:, 5] // 2))
    tracker = GroupTracker(rule, [0, 4])
    for _ in range(2):
        assert tracker.sensors() == list(range(9))
        tracker.report([1, 4])
        tracker = GroupTracker.restore(rule, tracker.state())
        assert tracker.sensors() == []
        tracker.report([None, None])


def test_a_network_that_reads_all_targets_is_not_merged() -> None:
    rule = JointRule(group(), Alternating(), torch.device("cpu"))
    with pytest.raises(UserError, match="merge=union: expected none, as the policy is of all"):
        evaluate(rule.group, rule, merge="union")


@pytest.mark.parametrize("merge", ["union", *later(["gains"])])
def test_one_targets_plan_is_learned_and_merged(merge: str, tmp_path: Path) -> None:
    few = {"total_frames": 4096, "frames_per_batch": 2048, "envs": 64}
    pair = group(cost=0.3)
    run = tm.train(pair, "model_based", folder=tmp_path, **few, **{"targets.merge": merge})
    assert run.several is not None
    merged = evaluate(pair, run.policy, merge=merge)
    assert merged.exact
    assert run.summary["several"]["figures"]["aihtr"]["mean"] == merged.aihtr.mean
    assert run.evaluation.aihtr == pytest.approx(evaluate(pair.kinds[0], run.policy).aihtr)
    for each in (run, tm.load_run(tmp_path)):  # by default as it was learned
        assert evaluate(pair, each).aihtr == merged.aihtr
    best = evaluate(pair, solve(pair), merge="gains")
    assert run.several.merged is not None
    assert run.several.merged.aihtr.mean == best.aihtr.mean
    assert merged.aihtr.mean <= run.summary["several"]["upper"]
    for words in ([f"targets.merge={merge}"], []):
        assert main(["evaluate", f"run={tmp_path}", *words, "quiet=true"]) == 0
        written = json.loads((tmp_path / "evaluation.json").read_text(encoding="utf-8"))
        assert written["figures"]["aihtr"]["mean"] == merged.aihtr.mean
    words = ["compare", f"run={tmp_path}", "baseline=qmdp", "quiet=true"]
    assert main([*words, f"hydra.run.dir={tmp_path / 'c'}"]) == 0
    written = json.loads((tmp_path / "c" / "comparison.json").read_text(encoding="utf-8"))
    assert written["policies"][0]["figures"]["aihtr"]["mean"] == merged.aihtr.mean


@pytest.mark.parametrize(
    ("words", "refusal"),
    [
        (["algo=a2c", "partition.block=2"], "partition.block=2: expected null with targets.count"),
        (["algo=a2c", "targets.merge=union"], "targets.merge=union: without effect with algo=a2c"),
        (["targets.count=1", "targets.merge=union"], "without effect with targets.count=1"),
        (["targets.count=1", "evaluation.width=1"], "without effect with targets.count=1"),
        (
            ["kernel=heading", "task.memory=displacement", "algo=a2c"],
            "memory=displacement: expected cell",
        ),
    ],
)
def test_words_without_effect_are_refused(
    words: list[str], refusal: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    count = [] if words[0] == "targets.count=1" else ["targets.count=2"]
    assert main(["train", *count, *words, f"hydra.run.dir={tmp_path / 'a'}"]) == 2
    assert refusal in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


def test_what_several_targets_cannot_do_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world, other = group().kinds[0], tm.make_world("drift", size=3, exit_probability=0.2)
    with pytest.raises(UserError, match="a Group of 2 motions, expected one with an algorithm"):
        tm.train(Group([world, other]), "model_based")
    run = tm.train(group(), "a2c", folder=tmp_path, **FEW, **BRIEF)
    with pytest.raises(UserError, match=r"actor: expected none with several targets"):
        tm.train(group(), "a2c", actor=run.policy.actor)
    with pytest.raises(UserError, match=r"learned for targets of the kinds \[0, 0\], expected"):
        evaluate(group(targets=3), run)
    assert main(["export", f"run={tmp_path}", "format=sets"]) == 2
    assert "2 targets that were learned together, expected a single" in capsys.readouterr().err
    assert main(["evaluate", f"run={tmp_path}", "targets.count=3"]) == 2
    assert "targets.count=3: expected 2, as the policy has" in capsys.readouterr().err
    assert main(["evaluate", f"run={tmp_path}", "targets.count=1"]) == 2
    assert "targets.count=1: expected at least 2, as the run has" in capsys.readouterr().err
    assert main(["evaluate", f"run={tmp_path}", "targets.merge=union"]) == 2
    assert "targets.merge=union: without effect with algo=a2c" in capsys.readouterr().err


def test_a_run_of_one_target_takes_no_option_of_several(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = {"total_frames": 2048, "frames_per_batch": 1024, "envs": 64, "optimal.enabled": False}
    tm.train(group().kinds[0], folder=tmp_path, **words)
    for word in ("targets.merge=union", "evaluation.width=0.1"):
        assert main(["evaluate", f"run={tmp_path}", word]) == 2
        assert f"{word}: without effect with targets.count=1" in capsys.readouterr().err
    assert not (tmp_path / "evaluation.json").exists()


@pytest.mark.parametrize("algo", ["a2c", *later(["dqn"])])
def test_episodes_are_logged_while_learning_and_verify_to_the_bit(
    algo: str, tmp_path: Path
) -> None:
    few = FEW | BRIEF
    mixed = Group([*group().worlds, tm.make_world("drift", size=3, exit_probability=0.2)])
    more = {"log": ["csv", "mcap"], "log.mcap.episodes": 7, "evaluation.every": 1}
    run = tm.train(mixed, algo, folder=tmp_path, **few, **more)
    with EpisodeReader(tmp_path / "episodes.mcap") as reader:
        assert len(reader) == 14  # after each of two iterations
        assert verify(reader).difference is None
        # The last policy of the log is the run's.
        last = reader.policy(1)
        assert isinstance(last, JointRule)
        for name, part in last.packed()[0].items():
            np.testing.assert_array_equal(part, run.policy.packed()[0][name])
        arrays = last.packed()[0]
        forged = {
            name: part * 1j if part.dtype.kind == "f" else part for name, part in arrays.items()
        }
        with pytest.raises(TypeError, match="complex"):
            joint_policy(load_run_config(tmp_path), mixed, forged)
        # One at a time, as a batch of another size rounds otherwise.
        assert verify(reader, numbers=[13]).difference is None


class BelowTheFirst(TensorDictModuleBase):
    """The sensor of the cell below the one where target 0 was located last."""

    in_keys = ("last_cell",)
    out_keys = ("action",)

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        return state.set("action", torch.arange(9) == state["last_cell"][:, :1] + 3)


def test_a_tracker_begins_with_each_target_in_its_cell() -> None:
    tracker = JointRule(group(), BelowTheFirst(), torch.device("cpu")).tracker([0, 4])
    assert tracker.sensors() == [3]
    tracker.report([3, None])
    assert tracker.sensors() == [6]


def test_a_loaded_run_follows_targets_step_by_step(tmp_path: Path) -> None:
    run = tm.train(group(), "a2c", folder=tmp_path, **FEW, **BRIEF)
    with pytest.raises(UserError, match="several targets learned together: load_run reads them"):
        tm.Tracker(tmp_path / "policy.npz", 0)
    tracker = tm.load_run(tmp_path).policy.tracker([0, 4])
    episode = next(e for e in tm.simulate(group(), run, 300) if e.start.tolist() == [0, 4])
    for t in range(len(episode)):
        expected = range(9) if tracker.safe else np.flatnonzero(episode.action[t])
        assert tracker.sensors() == list(expected)
        seen = zip(episode.target[t].tolist(), episode.located[t], strict=True)
        gone = np.flatnonzero(episode.target[t] == 9)
        tracker.report([cell if found else None for cell, found in seen], gone.tolist())


@pytest.mark.parametrize("loaded", [True, False])
def test_a_plan_learned_for_one_follows_several(loaded: bool, tmp_path: Path) -> None:
    """By the sets of all together, as the run's figures have it."""
    few = {name: each for name, each in FEW.items() if name != "hidden"}
    union = {**few, **BRIEF, "targets.merge": "union"}
    run = tm.train(group(), "model_based", folder=tmp_path, **union)
    tracker = (tm.load_run(tmp_path) if loaded else run).tracker([0, 4])
    own = (run.policy.tracker(cell).sensors() for cell in (0, 4))
    assert tracker.sensors() == sorted({sensor for sensors in own for sensor in sensors})
    rule = tm.load_run(tmp_path).rule
    assert tm.GroupTracker.restore(rule, tracker.state()).sensors() == tracker.sensors()
    with pytest.raises(UserError, match="a run of one target"):
        tm.train(tm.make_world(size=3), "model_based", **few).tracker([0, 4])


def test_runs_for_several_targets_are_compared_on_the_same_targets(tmp_path: Path) -> None:
    # .005 a step, which the comparison is made to, takes few episodes where rewards are small.
    targets = group(reward=0.1, cost=0.02)
    runs = tmp_path / "joint", tmp_path / "merged"
    words = {"total_frames": 4096, "frames_per_batch": 2048, "envs": 64}
    joint = tm.train(targets, "a2c", folder=runs[0], **FEW, **BRIEF)
    merged = tm.train(targets, "model_based", folder=runs[1], **words, **BRIEF)
    compared = tm.compare(targets, {"joint": joint, "merged": merged, "again": joint})
    assert compared.tracks is not None
    assert compared.about.endswith("simulated episodes, differences over the same targets")
    alone = [
        evaluate_group(group_rule(targets, each), episodes=compared.tracks)
        for each in (joint, merged)
    ]
    difference = compared.policies[1].difference
    assert difference == alone[1].less(alone[0]).aihtr
    assert difference.low is not None
    paired = (alone[1].totals - alone[0].totals)[:, 0].mean()
    assert abs(difference.mean - paired) < 3 * (difference.mean - difference.low)
    again = compared.policies[2].difference
    assert (again.mean, again.low, again.high) == (0.0, None, None)  # all agree
    main(["compare", *(f"run={run}" for run in runs), f"hydra.run.dir={tmp_path}", "quiet=true"])
    written = json.loads((tmp_path / "comparison.json").read_text(encoding="utf-8"))
    assert written["tracks"] == compared.tracks
    assert written["policies"][1]["difference"]["mean"] == difference.mean
    assert "(other problem)" not in written["policies"][1]["name"]


def test_exact_figures_for_several_targets_are_compared_exactly() -> None:
    union = make_rule(group(), [solve(group().kinds[0]).table], "union")
    compared = tm.compare(group(), {"union": union, "gains": "optimal", "same": union})
    assert compared.tracks is None
    exact = [evaluate(group(), each).aihtr.mean for each in (union, "optimal")]
    assert compared.policies[1].difference.mean == pytest.approx(exact[1] - exact[0])
    assert compared.sentences[1] == "same earns the same as union (exact)."


def below_the_bound(targets: Group, frames: int) -> float:
    """How far per step a2c ends below the bound, at most."""
    width: dict[str, Any] = {"evaluation.every": 1000, "evaluation.width": 0.02}
    run = tm.train(targets, "a2c", total_frames=frames, **width, **{"optimal.enabled": False})
    assert run.several is not None
    low = run.several.figures.reward_per_step.low
    assert low is not None
    return run.several.upper / targets.expected_steps - low


def test_a2c_with_joint_credit_learns_two_targets() -> None:
    # It begins 1.1 below.
    targets = tm.make_world(size=4, targets=2, exit_probability=0.05)
    assert below_the_bound(targets, 40_960) < 0.5


@pytest.mark.long
def test_a2c_with_joint_credit_learns_two_targets_to_within_a_tenth_of_the_bracket() -> None:
    assert below_the_bound(tm.make_world(size=4, targets=2), 81_920) < 0.1
