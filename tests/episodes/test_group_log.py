"""Episodes of several targets: simulated alike from their seeds, logged, read back, and found again bit for bit."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import trackmdp as tm
from tests.episodes import groups
from tests.episodes.logs import rewritten
from tests.solvers.test_group import tiny
from tests.solvers.test_group_modes import random_table, ring
from trackmdp.app.cli import main
from trackmdp.episodes import schema, writer
from trackmdp.episodes.belief_filter import beliefs
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.group_episodes import GroupEpisodes
from trackmdp.episodes.messages import form_of
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.episodes.simulate import resimulate
from trackmdp.errors import UserError
from trackmdp.solvers.several.merging import Rule, make_rule
from trackmdp.solvers.solve import solve
from trackmdp.world.group import Group
from trackmdp.world.model import World
from trackmdp.world.problem_file import problem_bytes


def missing(seed: int = 5) -> Group:
    """Three targets of two motions among sensors that miss."""
    world = tiny(seed, t_max=1, detection=np.array([0.8, 0.6, 1.0]))
    return Group([world, World.of(world, tiny(seed + 1).kernel), world])


def rule_of(group: Group, merge: str = "gains") -> Rule:
    return make_rule(group, [solve(each).table for each in group.kinds], merge)


GROUP = missing()
RULE = rule_of(GROUP)


def played(count: int, *, rule: Rule = RULE, seed: int = 0) -> list[Episode]:
    return list(tm.simulate(rule.group, rule, count, seed=seed).complete())


def write(file: Path, episodes: list[Episode], rule: Rule = RULE) -> Path:
    return groups.write(file, episodes, rule)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "a.mcap", played(20))


def test_an_episode_depends_on_its_own_seed_alone() -> None:
    episodes = tm.simulate(GROUP, RULE, 30, seed=1)
    again = next(resimulate(GROUP, RULE, episodes.seeds[17:18]).complete())
    assert first_difference(list(episodes.complete())[17], replace(again, number=17)) is None
    other = tm.simulate(GROUP, RULE, 30, seed=2)
    assert [len(each) for each in other] != [len(each) for each in episodes]


def test_targets_are_the_same_for_every_policy() -> None:
    one, other = (played(10, rule=rule_of(GROUP, merge)) for merge in ("gains", "union"))
    none = list(tm.simulate(GROUP, "none", 10).complete())
    for mine, theirs, without in zip(one, other, none, strict=True):
        assert np.array_equal(mine.target, theirs.target)
        assert np.array_equal(mine.target, without.target)


def test_rewards_and_clocks_are_those_of_the_rules() -> None:
    """Recomputed step by step from cells, sensors and reports."""
    task, cells = GROUP.task, GROUP.task.num_cells
    for episode in played(20):
        n, inside = np.zeros(3, int), np.ones(3, bool)
        for t in range(len(episode)):
            assert episode.misses[t].tolist() == n.tolist()
            forced = bool((n > task.t_max).any())
            now = episode.target[t] < cells
            assert not (now & ~inside).any()
            on = episode.action[t]
            seen = episode.located[t]
            assert not (seen & ~now).any()
            assert seen[now].all() if forced else on[episode.target[t][seen]].all()
            spent = task.safe_cost if forced else task.cost[on].sum()
            expected = seen.sum() * task.reward - spent * now.any()
            assert episode.reward[t] == pytest.approx(expected, abs=1e-6)
            n, inside = np.where(now & ~seen, n + 1, 0), now
        assert not inside.any()
        assert episode.terminated


def test_a_tracker_would_have_switched_on_the_same_sensors() -> None:
    for episode in played(10):
        assert len(list(groups.tracked(RULE, episode))) == len(episode)


def test_beliefs_are_those_of_a_filter_for_each_target() -> None:
    for episode in played(10):
        for k, single in enumerate(episode.singles()):
            assert single.belief is not None
            steps = 1 + int(np.argmax(single.target == 3))  # until it has left
            cut = replace(
                single,
                action=single.action | episode.forced(1)[:, None],
                located=single.located,
                misses=np.where(episode.forced(1), 2, 0),
            )
            (expected,) = beliefs(GROUP.worlds[k], [cut])
            assert single.belief[:steps] == pytest.approx(expected[:steps], abs=1e-6)
            assert not single.belief[steps:].any()


def test_simulated_figures_agree_with_the_joint_chain() -> None:
    world = tiny(3, t_max=1, detection=np.array([0.9, 0.6, 1.0]))
    rule = rule_of(Group([world, World.of(world, tiny(4).kernel)]))
    exact, found = tm.evaluate(rule.group, rule), tm.simulate(rule.group, rule, 1000).figures()
    assert exact.exact
    for name in ("aihtr", "accuracy", "sensors_per_step", "safe_per_step"):
        interval = getattr(found, name)
        half = (interval.high - interval.low) / 2
        assert abs(interval.mean - getattr(exact, name).mean) < 2 * half, name


def test_steps_are_as_the_environment_has_them() -> None:
    """Keys, shapes and types of a rollout; the history by hand."""
    env = tm.TrackEnv(GROUP, ())
    rollout = env.rollout(3, break_when_any_done=False)
    every = tm.simulate(GROUP, RULE, 5).to_tensordict()
    assert every["episode"].unique().tolist() == [0, 1, 2, 3, 4]
    del every["episode"]
    forms = {key: (rollout[key].shape[1:], rollout[key].dtype) for key in rollout.keys(True, True)}
    assert {
        key: (every[key].shape[1:], every[key].dtype) for key in every.keys(True, True)
    } == forms
    assert every["present"][0].all()
    assert not every["next", "present"][-1].any()
    # Sensor t is on in step t; the safe action in step 2, after which the history is empty.
    misses, action = np.array([[0], [1], [2], [0]]), np.eye(4, 3, dtype=bool)
    located, target = np.array([[False], [False], [True], [False]]), np.array([[0], [1], [2], [3]])
    episode = Episode(
        0, 0, 0, np.array([0]), misses, action, target, located, np.zeros(4, np.float32), True
    )
    steps = episode.to_tensordict(tiny(0, t_max=1))
    sensors = steps["action_history"].int().argmax(-1) * steps["action_history"].any(-1)
    assert steps["action_history"].any(-1).tolist() == [
        [False, False],
        [True, False],
        [True, True],
        [False, False],
    ]
    assert sensors.tolist()[2] == [1, 0]
    assert steps["next", "last_cell"].tolist() == [[0], [0], [2], [2]]


def test_episodes_come_back_bit_for_bit_in_any_order(log: Path) -> None:
    episodes = played(20)
    with EpisodeReader(log) as reader:
        for number in (19, 0, 7, 19):
            assert first_difference(episodes[number], reader.read(number)) is None
        assert reader.read(3).start.tolist() == episodes[3].start.tolist()
        for mine, theirs in zip(tm.simulate(GROUP, RULE, 20), reader, strict=True):
            expected = mine.to_tensordict(GROUP.task)
            assert (expected == theirs).all()
            assert torch.equal(expected["next", "reward"], theirs["next", "reward"])
        world = reader.world()
        assert world.kind.tolist() == [0, 1, 0]
        assert (world.worlds[1].kernel != GROUP.worlds[1].kernel).nnz == 0


def test_write_read_write_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    assert rewritten(log, tmp_path / "b.mcap").read_bytes() == log.read_bytes()
    assert write(tmp_path / "c.mcap", played(20)).read_bytes() == log.read_bytes()
    assert write(tmp_path / "d.mcap", played(20, seed=1)).read_bytes() != log.read_bytes()


@pytest.mark.parametrize("merge", ["gains", "union"])
def test_what_the_log_carries_simulates_again(merge: str, tmp_path: Path) -> None:
    rule = rule_of(missing(8), merge)
    file = write(tmp_path / "a.mcap", played(12, rule=rule), rule)
    with EpisodeReader(file) as reader:
        found = verify(reader)
        assert (found.episodes, found.difference) == (12, None)
        assert reader.policy(0).name == merge  # type: ignore[union-attr]


@pytest.mark.parametrize("name", ["target", "located", "misses", "reward", "action", "belief"])
def test_a_step_that_did_not_happen_is_found(name: str, tmp_path: Path) -> None:
    episodes = played(4)
    changed = np.array(
        getattr(episodes[2], name).toarray() if name == "belief" else getattr(episodes[2], name)
    )
    at = (1,) if name == "reward" else (1, 1)
    changed[at] = (
        not changed[at] if changed.dtype == bool else changed[at] + (1 if changed[at] < 2 else -1)
    )
    from scipy import sparse

    wrong = replace(
        episodes[2], **{name: sparse.csr_array(changed) if name == "belief" else changed}
    )
    file = write(tmp_path / "a.mcap", [*episodes[:2], wrong, episodes[3]])
    with EpisodeReader(file) as reader:
        found = verify(reader)
    assert found.episodes == 2
    assert found.difference is not None
    assert found.difference.startswith("episode 2, target ")
    assert name in found.difference or name in ("target", "located")


def test_the_mode_of_each_target_is_logged(tmp_path: Path) -> None:
    """In the ring a move of one cell shows mode 0, of two mode 1; the second target keeps the mode of its start."""
    group = Group([ring(0.3, detection=0.8), ring(0.0, detection=0.8)])
    rule = make_rule(group, [random_table(world, 1) for world in group.kinds], "union")
    episodes = played(30, rule=rule)
    for each in episodes:
        inside, before = each.target < 3, np.append(each.start[None], each.target[:-1], axis=0)
        assert each.mode is not None
        assert (each.mode == np.where(inside, (each.target - before) % 3 - 1, -1)).all()
        assert (each.mode[inside[:, 1], 1] == each.start_mode[1]).all()
    assert {each.start_mode[1] for each in episodes} == {0, 1}
    file = write(tmp_path / "a.mcap", episodes, rule)
    with EpisodeReader(file) as reader:
        pairs = zip(episodes, reader.episodes(), strict=True)
        assert not any(first_difference(mine, theirs) for mine, theirs in pairs)
        assert (verify(reader).episodes, verify(reader).difference) == (30, None)
    assert rewritten(file, tmp_path / "b.mcap").read_bytes() == file.read_bytes()
    for name in ("mode", "start_mode"):
        wrong = replace(episodes[0], **{name: 1 - getattr(episodes[0], name)})
        with EpisodeReader(write(tmp_path / f"{name}.mcap", [wrong], rule)) as reader:
            assert f"{name}: logged" in str(verify(reader).difference)


def test_flipped_bits_are_reported(log: Path, tmp_path: Path) -> None:
    content, rng, flipped = log.read_bytes(), random.Random(0), tmp_path / "flipped.mcap"
    expected = played(20)
    silent = 0
    for _ in range(40):
        damaged = bytearray(content)
        damaged[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        flipped.write_bytes(damaged)
        try:
            with EpisodeReader(flipped) as reader:
                found = list(reader.episodes())
        except UserError as error:
            assert "\n" not in str(error)
            continue
        silent += 1
        assert all(first_difference(a, b) is None for a, b in zip(expected, found, strict=True))
        with EpisodeReader(flipped) as reader, pytest.raises(UserError, match="not a whole log"):
            reader.check_all()
    assert silent < 20


def test_a_cut_log_gives_back_its_whole_episodes(log: Path, tmp_path: Path) -> None:
    content, expected = log.read_bytes(), played(20)
    part = tmp_path / "a.mcap.part"
    part.write_bytes(content[: len(content) * 2 // 5])
    saved = recover(part)
    assert 0 < saved.episodes < 20
    with EpisodeReader(saved.file) as reader:
        found = list(reader.episodes())
        assert verify(reader).difference is None
    assert all(
        first_difference(a, b) is None for a, b in zip(expected[: len(found)], found, strict=True)
    )


def test_a_log_with_a_problem_file_for_each_motion_is_of_another_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Format 4 had them: neither damage, nor anything that recover=true would mend."""
    with monkeypatch.context() as older:
        older.setattr(schema, "LOG_FORMAT", "4")
        older.setattr(writer, "problem_bytes", lambda group: problem_bytes(group.worlds[0]))
        file = write(tmp_path / "a.mcap", [])
    for read in (EpisodeReader, recover):
        with pytest.raises(UserError, match=r"^file=.*a.mcap: format 4 \(.*\), expected format 7$"):
            read(file)
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("said", ["x", "0 " * 1001, "1 0", "0 2 0", "-1", "0 0 3 1", ""])
def test_metadata_of_other_targets_than_the_problem_are_damage(
    said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = schema.shape_of(GROUP) | {"targets": said}
    with monkeypatch.context() as forged:
        forged.setattr(schema, "shape_of", lambda problem: other)
        file = write(tmp_path / "a.mcap", played(1))
    for read in (EpisodeReader, recover):
        with pytest.raises(UserError, match=r"metadata trackmdp.run of another problem"):
            read(file)


def test_steps_of_other_targets_are_damage(log: Path) -> None:
    with EpisodeReader(log) as reader:
        reader.form = form_of(Group(GROUP.worlds[:2]))
        reader.file = Path("a.mcap")
        with pytest.raises(UserError, match=r"file=a.mcap: not a whole log"):
            reader.read(0)


def test_simulate_takes_what_evaluate_takes_and_refuses_the_rest() -> None:
    group = tm.make_world("random_walk", size=3, targets=2, exit_probability=0.2)
    found = tm.simulate(group, solve(group), 4)
    assert isinstance(found, GroupEpisodes)
    assert [each.seed for each in found] == [each.seed for each in tm.simulate(group, "none", 4)]
    assert "targets" in repr(found) and "targets" in repr(found[0])
    with pytest.raises(UserError, match="does not draw, for several targets"):
        tm.simulate(group, tm.Policy.random_k(group.worlds[0], 1), 2)
    with pytest.raises(UserError, match="merge: an option of several targets"):
        tm.simulate(group.worlds[0], "none", 2, merge="gains")  # type: ignore[call-overload]
    with pytest.raises(UserError, match="merge=sum: expected gains or union"):
        tm.simulate(group, "none", 2, merge="sum")


def test_commands_log_and_replay_several_targets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "baseline=optimal", "grid.size=3", "targets.count=2", "log=[mcap]"]
    words += ["kernel.exit_probability=0.1", "episodes=5", "log.mcap.layout=true"]
    for name in ("a", "b"):
        assert main([*words, f"hydra.run.dir={tmp_path / name}"]) == 0
    file = tmp_path / "a" / "episodes.mcap"
    assert file.read_bytes() == (tmp_path / "b" / "episodes.mcap").read_bytes()
    assert "⓿" in (tmp_path / "a" / "picture.txt").read_text(encoding="utf-8")
    assert "│ AIHTR  " in capsys.readouterr().out
    assert main(["replay", f"file={file}"]) == 0
    assert "3x3 grid with 2 targets" in capsys.readouterr().out
    assert main(["replay", f"file={file}", "verify=true"]) == 0
    assert "5 episodes" in (said := capsys.readouterr().out) and "the same to the bit" in said
    assert main(["replay", f"file={file}", "episode=1"]) == 0
    said = capsys.readouterr().out
    with EpisodeReader(file) as reader:
        episode = reader.read(1)
    assert said.count("┌") == len(episode)
    assert "target 0 has left, target 1 has left" in said
    assert main(["replay", f"file={file}", f"csv={tmp_path / 't'}", "quiet=true"]) == 0
    head, first, *_ = (tmp_path / "t" / "steps.csv").read_text(encoding="utf-8").splitlines()
    row = dict(zip(head.split(","), first.split(","), strict=True))
    with EpisodeReader(file) as reader:
        start = reader.read(0)
    assert row["last_cell"] == " ".join(map(str, start.start.tolist()))
    assert row["n"] == "0 0"
    layout = json.loads((tmp_path / "a" / "episodes.layout.json").read_text(encoding="utf-8"))
    assert "/belief/1" in layout["configById"]["3D!belief"]["topics"]
    words = ["evaluate", "baseline=playback", f"baseline.file={file}", "grid.size=3"]
    assert main([*words, f"hydra.run.dir={tmp_path / 'c'}"]) == 2
    assert f"baseline.file={file}: of several targets, expected one" in capsys.readouterr().err


def test_a_safe_action_that_misses_is_logged_and_found_again(tmp_path: Path) -> None:
    world = tiny(5, t_max=1, safe_detection=np.array([0.3, 0.6, 1.0]), max_steps=9)
    rule = make_rule(Group([world] * 2), [tm.Policy.none(world)], "union")
    episodes = played(60, rule=rule)
    with EpisodeReader(write(tmp_path / "a.mcap", episodes, rule)) as reader:
        assert verify(reader).difference is None
        steps = [reader[number]["next", "steps_since_detection"] for number in range(60)]
    assert max(int(each.max()) for each in steps) == 2
    repeated = [(np.diff(each.misses, axis=0) == 0) & (each.misses[1:] == 2) for each in episodes]
    assert any(each.any() for each in repeated)
    assert any(each.truncated and (each.misses[-1] == 2).any() for each in episodes)
