"""Simulated episodes: each on its own generator, its steps those of the environment, its belief the filter's."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

import trackmdp as tm
from tests.episodes.logs import WORLD, policy, recorded
from tests.helpers import hop_world, limited, random_kernel, small_world
from tests.tracks import by_hand
from tests.tracks import recorded as recorded_tracks
from trackmdp.environment.dynamics import Dynamics
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.paths import path_sampler
from trackmdp.episodes.differences import first_difference
from trackmdp.episodes.episode import Episode
from trackmdp.episodes.sentences import sentence
from trackmdp.episodes.simulate import episode_seeds, resimulate, simulate
from trackmdp.errors import UserError
from trackmdp.policies import lookup
from trackmdp.policies.acting import Playback
from trackmdp.policies.belief import BeliefFilter
from trackmdp.policies.policy import Policy
from trackmdp.seeding import derive
from trackmdp.sensing.outcomes import Costs
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.group import Group
from trackmdp.world.model import World

ACTING = {
    "table": policy(),
    "random_k": Policy.random_k(WORLD, 3),
    "all_on": Policy.all_on(WORLD),
    "none": Policy.none(WORLD),
    "probabilities": Policy.from_dense(
        WORLD, np.random.default_rng(1).random((16, 3, 16)) * policy().dense()
    ),
}


WINDOWED = World(
    random_kernel(np.random.default_rng(0), 12, 0.04),
    (3, 4),
    cost=np.linspace(0.1, 0.3, 12),
    t_max=2,
    window=1,
)


def in_window(share: float = 0.5) -> Policy:
    """Some of the sensors that can be chosen."""
    near = Policy.all_on(WINDOWED).dense()
    return Policy.from_dense(WINDOWED, near & (np.random.default_rng(5).random(near.shape) < share))


def stepped_alone(world: World, acting: Policy, seed: int) -> TensorDict:
    """The episode as the environment itself makes it, one row, from the same draws."""
    rng = torch.Generator().manual_seed(seed)
    start, sampler = torch.randint(world.num_cells, (1,), generator=rng), path_sampler(world)
    dynamics, env = Dynamics(world, sampler), TrackEnv(world, 1)
    place, state = start, env.reset().set("last_cell", start.clone())
    steps: list[TensorDict] = []
    while True:
        if len(steps) % 256 == 0:
            block = sampler.draw(256, rng)
        state = acting(state)
        before, draws = {**state, "place": place}, block[len(steps) % 256].unsqueeze(0)
        following = TensorDict(dynamics.advance(before, state["action"], draws, None), [1])
        place = following.pop("place")
        steps.append(state.clone().set("next", following))
        if following["done"].item():
            return torch.cat(steps)
        state = following.select(*env.observation_spec)
        state.update(
            {
                key: torch.zeros(1, 1, dtype=torch.bool)
                for key in ("done", "terminated", "truncated")
            }
        )


@pytest.mark.parametrize("max_steps", [None, 7])
@pytest.mark.parametrize("window", [None, 1])
def test_an_episode_is_what_the_environment_makes_of_its_draws(
    max_steps: int | None, window: int | None
) -> None:
    """On a square, and on a rectangle of which only a window can be sensed, with actions in its own numbers."""
    world = limited(WORLD if window is None else WINDOWED, max_steps)
    acting = policy() if window is None else in_window()
    for number, episode in enumerate(simulate(world, acting, 12)):
        mine = episode.to_tensordict(world)
        theirs = stepped_alone(world, acting, derive(0, "episode", number))
        assert set(mine.keys(True, True)) == set(theirs.keys(True, True))
        for key in theirs.keys(True, True):
            assert mine[key].dtype == theirs[key].dtype, key
            assert torch.equal(mine[key], theirs[key]), key


@pytest.mark.parametrize("max_steps", [None, 9])
def test_its_keys_are_those_of_a_rollout(max_steps: int | None) -> None:
    env = TrackEnv(limited(WORLD, max_steps), 1)
    rollout = env.rollout(3, policy())
    mine = recorded(1, max_steps=max_steps)[0].to_tensordict(limited(WORLD, max_steps))
    assert set(mine.keys(True, True)) == set(rollout.keys(True, True))
    for key in mine.keys(True, True):
        assert mine[key].dtype == rollout[key].dtype
        assert mine[key].shape[1:] == rollout[key].shape[2:]


@pytest.mark.parametrize("name", ACTING)
@settings(max_examples=15)
@given(numbers=st.lists(st.integers(0, 299), min_size=1, max_size=5, unique=True))
def test_an_episode_is_the_same_alone_and_among_others(name: str, numbers: list[int]) -> None:
    everyone = together(name)
    seeds = [everyone[number].seed for number in numbers]
    for number, alone in zip(
        numbers, resimulate(WORLD, ACTING[name], seeds).complete(), strict=True
    ):
        assert first_difference(everyone[number], alone) is None


def test_the_belief_does_not_depend_on_how_many_are_recorded() -> None:
    """On a dense world of 100 cells, where a product of matrices would round otherwise for one row than for many."""
    world = small_world(10, t_max=3, exit_probability=0.05, seed=2)
    acting = Policy.random_k(world, 20)
    for number, episode in enumerate(resimulate(world, acting, range(40)).complete()):
        (alone,) = resimulate(world, acting, [number]).complete()
        assert first_difference(episode, alone) is None


def together(name: str, made: dict[str, list[Episode]] = {}) -> list[Episode]:  # noqa: B006  made once
    if name not in made:
        made[name] = recorded(300, acting=ACTING[name])
    return made[name]


@pytest.mark.parametrize("name", ACTING)
def test_the_belief_is_the_filters(name: str) -> None:
    exact = BeliefFilter(WORLD.kernel)
    for episode in together(name)[:10]:
        assert episode.belief is not None
        belief = exact.detect(np.array([episode.start]))
        for t in range(len(episode)):
            predicted = exact.predict(belief)
            np.testing.assert_allclose(episode.belief[t], predicted[0], rtol=1e-6, atol=1e-9)
            action, target = episode.action[t : t + 1], episode.target[t : t + 1]
            belief = exact.detect(target) if episode.located[t] else exact.miss(predicted, action)


def test_by_hand() -> None:
    """2x2, the target hops 0 -> 1 -> 2 -> 3 -> 0; only the sensor of cell 2 is ever on, T_max 1, D = 0.9, r = 2."""
    world = hop_world()
    only = np.zeros((4, 2, 4), dtype=bool)
    only[..., 2] = True
    episodes = resimulate(world, Policy.from_dense(world, only), range(400)).complete()
    episode = next(episode for episode in episodes if episode.start == 0 and len(episode) > 4)
    assert episode.belief is not None
    assert episode.target[:4].tolist() == [1, 2, 3, 0]
    assert episode.misses[:4].tolist() == [0, 1, 0, 1]
    assert episode.observation[:4].tolist() == [-1, 2, -1, -1]
    assert episode.last_cell[:4].tolist() == [0, 0, 2, 2]
    np.testing.assert_allclose(episode.reward[:4], [-0.3, 1.7, -0.3, -0.3], rtol=1e-6)
    np.testing.assert_allclose(episode.returns[:4], [-0.3, 1.4, 1.1, 0.8], rtol=1e-6)
    np.testing.assert_allclose(episode.belief[0], [0, 0.75, 0, 0])
    assert episode.misses[4] == 2
    assert episode.forced(1)[:5].tolist() == [False] * 4 + [True]
    assert (episode.target[-1], episode.terminated, episode.truncated) == (4, True, False)
    assert episode.reward[-1] == 0


def test_issued_actions_give_the_episode_again() -> None:
    for episode in together("random_k")[:20]:
        (again,) = resimulate(WORLD, Playback(WORLD, episode.action), [episode.seed]).complete()
        again = dataclasses.replace(again, probability=episode.probability)
        assert first_difference(episode, again) is None
    (longer,) = resimulate(WORLD, Playback(WORLD, episode.action[:1]), [episode.seed])
    assert not longer.action[1:].any()


def test_playback_of_more_sensors_than_the_budget_is_refused() -> None:
    world = dataclasses.replace(WORLD, budget=2)
    Playback(world, np.eye(16, dtype=bool) | np.eye(16, k=1, dtype=bool))
    with pytest.raises(UserError, match="playback: 3 sensors on in a step; expected 2"):
        Playback(world, np.arange(16)[None] < 3)


def test_playback_of_another_grid_is_refused() -> None:
    with pytest.raises(UserError, match=r"actions of \(9,\) sensors, expected 16"):
        Playback(WORLD, np.zeros((3, 9), dtype=bool))


@pytest.mark.parametrize("name", ACTING)
def test_batches_and_ways_of_looking_up_change_nothing(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trackmdp.episodes.actors._MOST_ROWS", 7)
    monkeypatch.setattr("trackmdp.episodes.actors._DRAWS", 100)
    monkeypatch.setattr("trackmdp.episodes.batch._BELIEF", 50)
    monkeypatch.setattr(lookup, "DENSE", 0)
    acting = Policy(WORLD, ACTING[name].sets, k=ACTING[name].k)
    for mine, other in zip(simulate(WORLD, acting, 40).complete(), together(name), strict=False):
        assert first_difference(mine, other) is None


def test_one_price_per_cell_is_paid_to_the_bit_as_in_the_environment() -> None:
    world = small_world(3, t_max=1, seed=3)
    world = World(world.kernel, 3, cost=np.random.default_rng(0).random(9), t_max=1)
    acting = Policy.from_dense(world, np.random.default_rng(4).random((9, 2, 9)) < 0.5)
    costs, n = Costs(world), torch.zeros(9, dtype=torch.int64)
    for k in range(2):
        written = costs.price_of(acting.act(torch.arange(9), n + k))
        assert acting.sets is not None
        assert torch.equal(costs.of_sets(acting.sets)[k::2], written)


def test_random_sets_come_from_the_second_generator_of_an_episode() -> None:
    """As in logs written before: blocks of 256 rows of draws, of which the k largest are on."""
    episode = max(together("random_k"), key=len)
    rng = torch.Generator().manual_seed(derive(episode.seed, "policy"))
    largest = torch.rand(256, 16, generator=rng).topk(3).indices[: len(episode)]
    assert episode.action[:256].nonzero()[1].tolist() == largest.sort().values.flatten().tolist()


def test_a_function_needs_no_table_of_its_own() -> None:
    table = torch.as_tensor(policy().dense())
    asked = simulate(WORLD, lambda x, n, h: table[x, n.clamp_max(2)], 20)
    for mine, other in zip(asked.complete(), recorded(20), strict=True):
        assert first_difference(mine, other) is None


def test_episodes_are_a_sequence() -> None:
    episodes = simulate(WORLD, policy(), 10)
    assert len(episodes) == 10
    assert [episode.number for episode in episodes] == list(range(10))
    assert [episode.number for episode in episodes[2:8:3]] == [2, 5]
    assert episodes[-1].seed == episode_seeds(0, 10)[9]
    assert episodes[0].belief is None
    with pytest.raises(IndexError):
        episodes[10]


def test_episodes_of_recorded_tracks_go_along_the_held_out_ones() -> None:
    setting = recorded_tracks(
        by_hand([0, 1, 2, 5], [4, 3], [8, 7, 4, 1], exits=[True, False, True])
    )
    closed = setting.held_out.closed(setting.num_cells)
    paths = [
        closed.cells[a:b].tolist() for a, b in zip(closed.first[:-1], closed.first[1:], strict=True)
    ]
    episodes = simulate(setting, Policy.all_on(setting), 50)
    for episode in episodes:
        path = [episode.start, *episode.target.tolist()]
        assert path in paths
        assert episode.terminated == (path[-1] == setting.num_cells)
        assert episode.truncated != episode.terminated
    assert len({episode.start for episode in episodes}) > 1


@pytest.mark.parametrize("coverage", [None, np.eye(9) + np.eye(9, k=1)])
@pytest.mark.parametrize("made_for", [1.0, 0.5])
def test_the_sensors_are_those_of_the_world_whatever_the_policy_was_made_for(
    made_for: float, coverage: Any
) -> None:
    worlds = {
        p: dataclasses.replace(small_world(), detection=p, coverage=coverage) for p in (1.0, 0.5)
    }
    world = worlds[1.5 - made_for]
    sets = np.random.default_rng(0).random((9, 2, 9)) < 0.4
    for table in (sets, sets * 0.5):
        own = Policy.from_dense(worlds[made_for], table)
        found = simulate(world, own, 500).figures().accuracy
        assert found.mean == pytest.approx(
            evaluate(world, own).accuracy, abs=4 * found.standard_error
        )


CHANGES: list[tuple[str, Any, str]] = [
    ("seed", 5, "seed: logged 5, "),
    ("start", -1, "start: logged -1, "),
    ("truncated", True, "truncated: logged True, "),
    ("reward", 2, "step 2, reward: logged "),
    ("target", 1, "step 1, target: logged "),
    ("action", (3, 7), "step 3, action of cell 7: logged "),
    ("belief", (0, 2), "step 0, belief of cell 2: logged "),
]


@pytest.mark.parametrize(("name", "change", "message"), CHANGES)
def test_the_first_difference_is_named(name: str, change: Any, message: str) -> None:
    episode = max(recorded(5), key=len)
    value = getattr(episode, name)
    if isinstance(value, np.ndarray):
        value = value.copy()
        value[change] = ~value[change] if value.dtype == bool else value[change] + 1
        value[-1] = value[0]
    else:
        value = change
    changed = dataclasses.replace(episode, **{name: value})
    assert (first_difference(changed, episode) or "").startswith(message)


def test_a_belief_within_the_tolerance_passes() -> None:
    episode = recorded(1)[0]
    assert episode.belief is not None
    changed = dataclasses.replace(episode, belief=episode.belief + np.float32(1e-7))
    assert first_difference(changed, episode)
    assert first_difference(changed, episode, belief_tolerance=1e-6) is None
    changed.belief[0, 0] = np.nan
    assert (first_difference(changed, episode, belief_tolerance=1e-6) or "").startswith(
        "step 0, belief of cell 0"
    )


@pytest.mark.parametrize("episodes", [-1, 1.5, "3"])
def test_a_number_of_episodes_that_is_none_is_refused(episodes: Any) -> None:
    with pytest.raises(UserError, match=f"episodes={episodes!r}"):
        simulate(WORLD, policy(), episodes)


@pytest.mark.parametrize("problem", [WORLD, Group([WORLD, WORLD])])
def test_episodes_that_do_not_fit_are_refused_before_any_is_kept(problem: Any) -> None:
    with pytest.raises(UserError, match=r"episodes=1000000000: needs about [0-9.,]+ GiB"):
        simulate(problem, "none", 10**9)


def test_the_size_of_episodes_is_that_of_their_arrays() -> None:
    two = simulate(Group([WORLD, WORLD]), "none", 2)
    # Two targets' misses and cells of four bytes, sensors and reward of four, located of two targets and truncated of
    # one, and 16 bits of sensors; starts of both, and where each begins.
    assert two.nbytes == (16 + 8 + 3 + 2) * len(two.target) + 8 * (4 + 3)
    one = simulate(WORLD, "none", 9)
    # Misses, target, sensors, reward of four bytes, located and truncated of one; start, its mode, and where it begins.
    assert one.nbytes == 18 * len(one.target) + 8 * (9 + 9 + 10)


def test_a_seed_that_is_no_whole_number_is_refused() -> None:
    for make in (
        lambda seed: simulate(WORLD, policy(), 1, seed=seed),
        lambda seed: TrackEnv(WORLD, 2, seed=seed),
    ):
        with pytest.raises(UserError, match=r"seed=1\.5"):
            make(1.5)


def test_all_steps_are_one_tensordict() -> None:
    episodes = simulate(WORLD, "qmdp", 4)
    steps = episodes.to_tensordict()
    assert len(steps) == len(episodes.target)
    assert steps["episode"].bincount().tolist() == [len(each) for each in episodes]
    mine = steps[steps["episode"] == 2].exclude("episode")
    assert (mine == episodes[2].to_tensordict(WORLD)).all()
    assert len(simulate(WORLD, "qmdp", 0).to_tensordict()) == 0


def test_a_safe_action_that_misses_is_told_so() -> None:
    world = tm.make_world("random_walk", size=3, t_max=0, safe_detection=0.3)
    (episode,) = simulate(world, Policy.none(world), 1)
    # Without T_max it is not known which sets the safe action replaced.
    assert "sensors per step" not in dict(episode.card().facts)
    forced, inside = episode.misses > 0, episode.target < 9
    for seen, word in ((True, "located"), (False, "missed")):
        (t, *_) = np.flatnonzero(forced & inside & (episode.located == seen))
        assert f": safe action forced, target {word} in row" in sentence(episode, t, world)
