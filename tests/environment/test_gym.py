"""`trackmdp/Track-v0`: Gymnasium's own checks, the target in `info`, and the same episodes as `TrackEnv`."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import check_env_specs

import trackmdp.gym
from tests.helpers import hop_world, limited, small_world
from tests.tracks import by_hand, recorded
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.render import PICTURE_LEGEND
from trackmdp.errors import UserError
from trackmdp.world.group import Group
from trackmdp.world.model import World

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

ID = trackmdp.gym.ID
WORLD = small_world(t_max=2)
PROBLEMS: dict[str, Any] = {
    "world": WORLD,
    "limited": limited(WORLD, 6),
    "window": World(np.full((20, 20), 0.04), (4, 5), cost=0.1, t_max=1, window=1),
    "tracks": recorded(by_hand([0, 1, 2], [3, 4, 5, 8], exits=True)),
    "budget": World(np.full((9, 9), 0.1), 3, cost=0.1, t_max=1, budget=2),
    "group": Group([WORLD] * 2),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_passes_gymnasiums_checker(name: str) -> None:
    check_env(gymnasium.make(ID, world=PROBLEMS[name], render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize(
    "how",
    [
        "import gymnasium, trackmdp",
        "import trackmdp, gymnasium",
        "import trackmdp.gym, gymnasium",
        "import gymnasium.envs.registration, trackmdp",
    ],
)
def test_it_is_registered_in_any_order_before_torch_is_loaded(how: str) -> None:
    code = f"import sys\n{how}\nprint(gymnasium.spec({ID!r}).id, 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"{ID} False\n"), done.stderr


def test_trackmdp_does_not_import_gymnasium() -> None:
    code = "import sys, trackmdp\nprint('gymnasium' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout == "False\n", done.stderr


@pytest.mark.parametrize("name", [ID, f"trackmdp:{ID}"])
def test_it_is_made_by_its_name_with_a_world_of_options(name: str) -> None:
    env = gymnasium.make(name, kernel="random_walk", size=3, stay=0.5, render_mode="ansi")
    env.reset(seed=1)
    assert env.render().count("·") == 9  # eight cells, one in the legend
    assert str(env.action_space) == "MultiBinary(9)"
    leaving = gymnasium.make(name, size=3, exit_probability=0.3).unwrapped.world
    assert leaving.stay_probability == pytest.approx(np.full(9, 0.7))


@pytest.mark.parametrize("how", ["by name", "wrapped"])
def test_torchrls_own_wrappers_take_it(how: str) -> None:
    if how == "by name":
        env = GymEnv(ID, world=WORLD, categorical_action_encoding=True)
    else:
        env = GymWrapper(gymnasium.make(ID, world=WORLD), categorical_action_encoding=True)
    check_env_specs(env)
    assert env.action_spec.shape == (9,)
    assert env.rollout(3)["action_history"].shape[1:] == (3, 9)


@pytest.mark.parametrize("wrong", [np.nan, 2, -1, 0.5])
def test_actions_other_than_0_and_1_are_refused(wrong: float) -> None:
    for env, shape in (
        (gymnasium.make(ID, world=WORLD).unwrapped, (9,)),
        (gymnasium.make_vec(ID, num_envs=2, world=WORLD).unwrapped, (2, 9)),
    ):
        env.reset(seed=0)
        with pytest.raises(UserError, match="action: expected 0 or 1 for each sensor, got"):
            env.step(np.full(shape, wrong))
        with pytest.raises(UserError, match="action: expected 0 or 1 for each sensor"):
            env.step(np.ones((*shape[:-1], 8)))


@pytest.mark.parametrize("how", ["own", "sync", "one"])
def test_sampled_actions_keep_to_the_budget(how: str) -> None:
    """Of 9 sensors 2 at most; all sets of 0, 1 and 2 are drawn, 1 + 9 + 36."""
    world = PROBLEMS["budget"]
    if how == "one":
        env = gymnasium.make(ID, world=world)
    else:
        mode = "vector_entry_point" if how == "own" else "sync"
        env = gymnasium.make_vec(ID, 3, world=world, vectorization_mode=mode)
    space = env.action_space
    space.seed(0)
    env.reset(seed=0)
    drawn = [space.sample() for _ in range(1000)]
    assert all(space.contains(each) for each in drawn)
    assert not space.contains(np.ones_like(drawn[0]))
    assert len(np.unique(np.concatenate(drawn).reshape(-1, 9), axis=0)) == 46
    for each in drawn[:50]:
        if np.all(env.step(each)[2]):
            env.reset()


def test_a_step_by_hand() -> None:
    """The target hops from cell to cell of 2 x 2; r = 2, c = 0.1, 0.2, 0.3, 0.4; only the cell after is sensed."""
    env = gymnasium.make(ID, world=hop_world(t_max=1), render_mode="ansi")
    seen, info = env.reset(seed=0)
    while True:
        before = info["target"]
        assert seen["last_cell"] == before
        after = (before + 1) % 4
        seen, reward, terminated, truncated, info = env.step(np.arange(4) == after)
        assert not truncated
        if terminated:
            assert (reward, info["target"]) == (0.0, 4)
            break
        assert info["target"] == after
        assert reward == pytest.approx(2 - 0.1 * (after + 1))
        assert env.render().count("●") == 2  # one in the legend


@pytest.mark.parametrize("name", ["world", "limited", "group"])
def test_a_batch_is_that_of_the_environment(name: str) -> None:
    """300 steps of 8 targets: the same rewards and ends, observations after an end those of the next episode."""
    env = gymnasium.make_vec(ID, num_envs=8, world=PROBLEMS[name])
    assert type(env.unwrapped).__name__ == "TrackVector"
    seen, info = env.reset(seed=3)
    mine = TrackEnv(
        PROBLEMS[name], 8, seed=int(np.random.Generator(np.random.PCG64(3)).integers(2**31))
    )
    rows, rng = mine.reset(), np.random.default_rng(0)
    for _ in range(300):
        action = rng.random((8, 9)) < 0.5
        assert torch.equal(torch.as_tensor(info["target"]), mine.target)
        seen, reward, terminated, truncated, info = env.step(action)
        frame, rows = mine.step_and_maybe_reset(rows.set("action", torch.as_tensor(action)))
        assert env.observation_space.contains(seen)
        for key, value in seen.items():
            assert np.array_equal(value, rows[key].numpy()), key
        for key, value in {
            "reward": reward,
            "terminated": terminated,
            "truncated": truncated,
        }.items():
            assert np.array_equal(value, frame["next", key].squeeze(-1).numpy()), key
        done = terminated | truncated
        assert np.array_equal(info.get("_final_obs", np.zeros(8, bool)), done)
        for row in np.flatnonzero(done):
            final = info["final_obs"][row]
            misses = frame["next", "steps_since_detection"][row]
            assert np.array_equal(final["steps_since_detection"], misses)
            assert (info["final_info"]["target"][row] == 9).all() == terminated[row]


def test_without_a_seed_episodes_are_those_of_the_generator_that_was_there() -> None:
    """Before the first reset somebody may have looked at it, or put another in its place."""
    starts = []
    for seed in (1, 1, 2):
        env = gymnasium.make(ID, world=WORLD)
        env.unwrapped.np_random = np.random.default_rng(seed)
        starts.append([env.reset()[1]["target"] for _ in range(12)])
    assert starts[0] == starts[1] != starts[2]


def test_an_unknown_option_is_a_type_error() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'grid_size'"):
        gymnasium.make(ID, grid_size=3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"world": WORLD, "size": 4}, "size: expected either a world, or options to make one of"),
        ({"render_mode": "svg"}, "render_mode=svg: expected one of ansi, human, rgb_array"),
        ({"size": 0}, "size=0"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*render")
def test_what_is_wrong_is_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        gymnasium.make(ID, **options)


def test_a_human_sees_every_step(capsys: pytest.CaptureFixture[str]) -> None:
    env = gymnasium.make(ID, world=WORLD, render_mode="human")
    env.reset(seed=0)
    env.step(np.ones(env.action_space.n, np.int8))
    assert capsys.readouterr().out.count(PICTURE_LEGEND) == 2
    assert env.render() is None


def test_a_human_sees_the_step_at_an_episodes_end_once(capsys: pytest.CaptureFixture[str]) -> None:
    envs = gymnasium.make_vec(
        ID,
        num_envs=2,
        kernel="random_walk",
        size=3,
        exit_probability=0.9,
        max_steps=2,
        render_mode="human",
    )
    envs.reset(seed=0)
    ended = [envs.step(np.ones(envs.action_space.shape, np.int8))[2:4] for _ in range(3)]
    assert np.any(ended)
    assert capsys.readouterr().out.count(PICTURE_LEGEND) == 4
