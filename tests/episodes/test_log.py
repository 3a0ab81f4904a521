"""What is written is what is read, to the bit, whichever way it is read."""

from __future__ import annotations

import json
from base64 import b64decode
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import trackmdp as tm
from tests.episodes.logs import CONFIG, WORLD, policy, recorded, rewritten, write
from tests.episodes.test_simulate import WINDOWED
from tests.tracks import by_hand, digest_of
from tests.tracks import recorded as recorded_tracks
from trackmdp.environment.env import TrackEnv
from trackmdp.episodes import schema
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.episode_page import page
from trackmdp.episodes.reader import EpisodeReader, verify
from trackmdp.episodes.recover import recover
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.errors import UserError
from trackmdp.motion.kernels import random_walk
from trackmdp.policies.policy import Policy
from trackmdp.world.model import World


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "a.mcap", recorded(30))


def test_episodes_come_back_bit_for_bit_in_any_order(log: Path) -> None:
    with EpisodeReader(log) as reader:
        assert len(reader) == 30
        for number in (29, 0, 17, 16, 29):
            assert first_difference(recorded(30)[number], reader.read(number)) is None
        expected = [episode.to_tensordict(WORLD) for episode in recorded(30)]
        for mine, theirs in zip(expected, reader, strict=True):
            assert (mine == theirs).all()
            assert torch.equal(mine["next", "reward"], theirs["next", "reward"])


def test_write_read_write_gives_the_same_bytes(log: Path, tmp_path: Path) -> None:
    assert rewritten(log, tmp_path / "b.mcap").read_bytes() == log.read_bytes()
    assert write(tmp_path / "c.mcap", recorded(30)).read_bytes() == log.read_bytes()
    assert write(tmp_path / "d.mcap", recorded(30, seed=1)).read_bytes() != log.read_bytes()


def test_a_random_policy_and_cut_episodes_come_back_too(tmp_path: Path) -> None:
    acting = Policy.random_k(WORLD, 3)
    episodes = recorded(10, acting=acting, max_steps=6)
    file = write(tmp_path / "a.mcap", episodes, acting=acting, max_steps=6)
    with EpisodeReader(file) as reader:
        assert all(
            first_difference(a, b) is None for a, b in zip(episodes, reader.episodes(), strict=True)
        )
        assert (reader.world().max_steps, reader.policy(0).k) == (6, 3)
        assert verify(reader).difference is None
        assert any(row["truncated"] for row in reader.rows)
        assert reader[0]["step_count"].tolist() == list(range(len(reader.read(0))))
    assert rewritten(file, tmp_path / "b.mcap").read_bytes() == file.read_bytes()


@pytest.mark.parametrize("k", [None, 2])
def test_a_rectangle_with_a_window_comes_back_and_verifies(k: int | None, tmp_path: Path) -> None:
    acting = Policy.all_on(WINDOWED) if k is None else Policy.random_k(WINDOWED, k)
    episodes = recorded(10, acting=acting, world=WINDOWED)
    file = write(tmp_path / "a.mcap", episodes, acting=acting, world=WINDOWED)
    with EpisodeReader(file) as reader:
        assert (reader.world().size, reader.world().window) == ((3, 4), 1)
        assert all(
            first_difference(a, b) is None for a, b in zip(episodes, reader.episodes(), strict=True)
        )
        assert verify(reader).difference is None
        assert reader[0]["action"].shape[1:] == (9,)
        assert reader.read(0).action.sum(1).max() <= (9 if k is None else k)
    file.replace(tmp_path / "b.mcap.part")
    saved = recover(tmp_path / "b.mcap.part")
    with EpisodeReader(saved.file) as reader:
        assert all(
            first_difference(a, b) is None for a, b in zip(episodes, reader.episodes(), strict=True)
        )


def test_it_feeds_a_replay_buffer(log: Path) -> None:
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(5000), batch_size=16)
    with EpisodeReader(log) as reader:
        buffer.extend(torch.cat(list(reader)))
    assert len(buffer) == sum(map(len, recorded(30)))
    assert buffer.sample()["next", "action_history"].shape == (16, 3, 16)


def test_what_the_log_carries_simulates_again(log: Path) -> None:
    with EpisodeReader(log) as reader:
        world = reader.world()
        assert (world.kernel != WORLD.kernel).nnz == 0
        assert (world.cost == WORLD.cost).all()
        assert (world.size, world.t_max, world.reward, world.safe_cost) == (
            (4, 4),
            2,
            WORLD.reward,
            WORLD.safe_cost,
        )
        assert (reader.policy(0).dense() == policy().dense()).all()
        assert reader.attachment("config.yaml").decode() == CONFIG
        assert schema.versions().items() <= reader.said.items()
        verified = verify(reader)
        assert (verified.episodes, verified.difference) == (30, None)
        assert verified.steps == sum(map(len, recorded(30)))


def test_rows_say_what_became_of_each_episode(log: Path) -> None:
    with EpisodeReader(log) as reader:
        for row, episode in zip(reader.rows, recorded(30), strict=True):
            assert row["seed"] == str(episode.seed)
            assert row["length"] == len(episode)
            assert row["return"] == pytest.approx(episode.reward.astype(float).sum(), abs=1e-9)
            assert row["detections"] == episode.located.sum()
            assert (
                int(row["end_time"]) - int(row["start_time"]) == (len(episode) - 1) * schema.TICK_NS
            )
        gaps = [
            int(b["start_time"]) - int(a["end_time"])
            for a, b in zip(reader.rows, reader.rows[1:], strict=False)
        ]
        assert min(gaps) > schema.TICK_NS
        with pytest.raises(UserError, match=r"episode=30: .* holds 30 episodes \(0 to 29\)"):
            reader[30]


def test_the_name_appears_only_with_the_end(tmp_path: Path) -> None:
    writer = EpisodeWriter.of(tmp_path / "a.mcap", WORLD, facts={}, config=CONFIG)
    assert {file.name for file in tmp_path.iterdir()} == {"a.mcap.part"}
    writer.finish()
    assert {file.name for file in tmp_path.iterdir()} == {"a.mcap"}
    with EpisodeReader(tmp_path / "a.mcap") as empty:
        assert (len(empty), list(empty)) == (0, [])


def test_a_bad_episode_does_not_spoil_the_file(tmp_path: Path) -> None:
    good, bad = recorded(2)
    bad.reward[0] = np.nan
    writer = EpisodeWriter.of(tmp_path / "a.mcap", WORLD, facts={}, config=CONFIG)
    writer.add_policy({}, policy())
    with pytest.raises(ValueError, match="not finite"):
        writer.add(bad)
    writer.add(good)
    with EpisodeReader(writer.finish()) as reader:
        assert first_difference(good, reader.read(0)) is None


def test_grid_messages_keep_to_the_rules_of_viewers(log: Path) -> None:
    """A field ends within its cell, a row within its stride, data are whole rows; no null, no array of arrays."""
    with EpisodeReader(log) as reader:
        ends = (int(reader.rows[0][name]) for name in ("start_time", "end_time"))
        messages = reader._container.messages_around(*ends)
        said = json.loads(next(data for topic, _, data in messages if topic == "/grid"))
    size = {1: 1, 7: 4}
    assert all(
        each["offset"] + size[each["type"]] <= said["cell_stride"] for each in said["fields"]
    )
    assert said["row_stride"] >= said["column_count"] * said["cell_stride"]
    data = b64decode(said["data"])
    assert len(data) == 4 * said["row_stride"]
    lowest = np.frombuffer(data[:4], "<f4")[0]  # belief of the first cell of the last of our rows
    assert lowest == recorded(1)[0].belief[0, 12]
    assert "null" not in json.dumps(list(schema.schemas_of(WORLD).values()))


def test_a_log_of_a_rectangle_comes_back(tmp_path: Path) -> None:
    kernel = random_walk((3, 5), stay=0.3, diagonal=True, exit_probability=0.1, border="clip")
    world = World(kernel, (3, 5), cost=0.2, t_max=1)
    episodes = recorded(6, world=world)
    with EpisodeReader(write(tmp_path / "a.mcap", episodes, world=world)) as reader:
        assert (reader.world().size, reader.said["size"], reader.said["columns"]) == (
            (3, 5),
            "3",
            "5",
        )
        assert all(
            first_difference(a, b) is None for a, b in zip(episodes, reader.episodes(), strict=True)
        )
        assert verify(reader).difference is None
        assert '"columns":5' in page(reader.world(), reader.read(0))


def test_a_log_of_a_side_above_a_thousand_cells_comes_back(tmp_path: Path) -> None:
    kernel = random_walk((3, 1100), stay=0.3, diagonal=True, exit_probability=0.3, border="clip")
    world = World(kernel, (3, 1100), cost=0.001, t_max=1, window=3)
    acting = Policy.all_on(world)
    episodes = recorded(3, world=world, acting=acting)
    file = write(tmp_path / "a.mcap", episodes, world=world, acting=acting)
    with EpisodeReader(file) as reader:
        assert (reader.world().size, reader.world().window) == ((3, 1100), 3)
        assert verify(reader).difference is None


DRAWN = Policy.from_dense(WORLD, np.full((WORLD.num_cells, 3, WORLD.num_cells), 0.3))


@pytest.mark.parametrize("acting", [policy(), Policy.all_on(WORLD), Policy.none(WORLD), DRAWN])
def test_a_policy_of_any_kind_is_read_back_and_acts_again(tmp_path: Path, acting: Policy) -> None:
    file = write(tmp_path / "a.mcap", recorded(10, acting=acting), acting=acting)
    with EpisodeReader(file) as reader:
        reader.check_all()
        assert np.array_equal(reader.world().kernel.toarray(), WORLD.kernel.toarray())
        found = reader.policy(0)
        assert (found.alike, found.k) == (acting.alike, acting.k)
        assert np.array_equal(found.sets.toarray(), acting.sets.toarray())
        assert verify(reader).difference is None
    assert recover(file).file.read_bytes() == file.read_bytes()


def test_a_policy_without_a_table_cannot_act_again(tmp_path: Path) -> None:
    writer = EpisodeWriter.of(tmp_path / "a.mcap", WORLD, facts={}, config=CONFIG)
    writer.add_policy({}, None)
    for episode in recorded(1):
        writer.add(episode)
    with EpisodeReader(writer.finish()) as reader, pytest.raises(UserError, match="policy 0"):
        verify(reader)


def test_a_log_along_recorded_tracks_comes_back(tmp_path: Path) -> None:
    """It holds the held-out tracks alone, along which its episodes are simulated again."""
    setting = recorded_tracks(
        by_hand([0, 1, 2, 5], [4, 3], [8, 7, 4, 1], exits=[True, False, True])
    )
    acting = Policy.all_on(setting)
    episodes = list(simulate(setting, acting, 5).complete())
    assert not any(each.belief.any() for each in episodes)  # no motion model, no belief
    file = write(tmp_path / "a.mcap", episodes, acting=acting, world=setting)
    with EpisodeReader(file) as reader:
        assert verify(reader).difference is None
        found = reader.world()
        assert digest_of(found.held_out) == digest_of(found.tracks) == digest_of(setting.held_out)
    assert recover(file).file.read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    "options", [{"memory": "displacement"}, {"memory": "displacement_gap", "reveals": True}]
)
def test_an_episode_has_the_memory_that_the_environment_shows(options: dict[str, Any]) -> None:
    world = tm.make_world("heading", size=3, t_max=1, **options)
    episodes = tm.simulate(world, Policy.random_k(world, 3), 5)
    mine = episodes.to_tensordict()
    assert set(mine.keys(True, True)) - {"episode"} == set(
        TrackEnv(world).rollout(1).keys(True, True)
    )
    assert np.array_equal(mine["key"], episodes.key)
    going_on = ~mine["next", "done"][:-1, 0]
    assert torch.equal(mine["next", "key"][:-1][going_on], mine["key"][1:][going_on])


def test_an_episode_has_the_mask_of_the_sensors_that_exist() -> None:
    cost = np.full(9, 0.1)
    cost[3] = np.nan
    mine = tm.simulate(world := tm.make_world("random_walk", size=3, cost=cost), "qmdp", 2)[0]
    steps = mine.to_tensordict(world)
    assert steps["action_mask"].tolist() == [(~np.isnan(cost)).tolist()] * len(mine)
    assert (steps["next", "action_mask"] == steps["action_mask"]).all()
