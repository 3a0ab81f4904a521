"""Batch is a law: every row lives on its own."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase

from tests.acting import RandomSubset
from tests.helpers import advanced, limited, random_state, small_world, worlds
from trackmdp.environment.env import TrackEnv
from trackmdp.seeding import generator
from trackmdp.world.model import World

SEEDS = st.integers(0, 2**32 - 1)
LIMITS = st.sampled_from([None, 3])


def states(
    world: World, rows: int, seed: int, max_steps: int | None
) -> tuple[TensorDict, torch.Tensor]:
    before, rng = random_state(world, rows, seed), torch.Generator().manual_seed(seed)
    if max_steps:
        before["step_count"] = torch.randint(max_steps, (rows,), generator=rng)
    draws = torch.rand(rows, dtype=torch.float64, generator=rng)
    draws[torch.rand(rows, generator=rng) < 0.2] = 1 - 2.0**-40
    return before, draws


def equal(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    assert set(first) == set(second)
    return all(torch.equal(first[key], second[key]) for key in first)


@given(worlds(), st.integers(1, 20), SEEDS, LIMITS)
def test_rows_together_equal_rows_alone(
    world: World, rows: int, seed: int, max_steps: int | None
) -> None:
    before, draws = states(world, rows, seed, max_steps)
    cut = limited(world, max_steps)
    together = advanced(cut, before, draws)
    alone = [advanced(cut, before[i : i + 1], draws[i : i + 1]) for i in range(rows)]
    assert equal(together, {key: torch.cat([row[key] for row in alone]) for key in together})


@given(worlds(), st.integers(2, 20), SEEDS, LIMITS)
def test_permuted_rows_give_permuted_results(
    world: World, rows: int, seed: int, max_steps: int | None
) -> None:
    before, draws = states(world, rows, seed, max_steps)
    cut = limited(world, max_steps)
    order = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))
    straight, permuted = (
        advanced(cut, *each) for each in ((before, draws), (before[order], draws[order]))
    )
    assert equal({key: value[order] for key, value in straight.items()}, permuted)


@given(worlds(), st.integers(1, 20), SEEDS)
def test_a_step_leaves_its_input_as_it_was(world: World, rows: int, seed: int) -> None:
    before, draws = states(world, rows, seed, 3)
    kept = before.clone()
    advanced(limited(world, 3), before, draws)
    assert (before == kept).all()


@given(SEEDS, st.lists(st.booleans(), min_size=6, max_size=6), LIMITS)
def test_a_partial_reset_leaves_the_other_rows(
    seed: int, mask: list[bool], max_steps: int | None
) -> None:
    world = small_world(t_max=2)
    env, rows = TrackEnv(limited(world, max_steps), 6, seed=seed), torch.tensor(mask)
    before = _midway(env)
    was = env.target
    after = env.reset(before.clone().set("_reset", rows.unsqueeze(-1)))
    for key in env.observation_spec:
        assert torch.equal(after[key][~rows], before[key][~rows])
    assert torch.equal(env.target[~rows], was[~rows])
    assert torch.equal(after["last_cell"][rows], env.target[rows])
    assert not after["steps_since_detection"][rows].any()
    assert not after["action_history"][rows].any()
    assert not after["done"].any()
    if max_steps:
        assert not after["step_count"][rows].any()


def _midway(env: TrackEnv) -> TensorDictBase:
    policy, rows = RandomSubset(9, generator(0, "policy")), env.reset()
    for _ in range(2):
        _, rows = env.step_and_maybe_reset(policy(rows))
    return rows


def test_rows_that_end_are_the_only_ones_reset() -> None:
    """The rows carried on are those of the step, bit for bit, wherever no episode ended."""
    env = TrackEnv(limited(small_world(t_max=2), 6), 200, seed=1)
    policy, rows, fresh = RandomSubset(9, generator(0, "policy")), env.reset(), 0
    for _ in range(100):
        frame, rows = env.step_and_maybe_reset(policy(rows))
        done = frame["next", "done"].squeeze(-1)
        for key in env.observation_spec:
            assert torch.equal(rows[key][~done], frame["next", key][~done])
        assert torch.equal(rows["last_cell"][done], env.target[done])
        assert not rows["steps_since_detection"][done].any()
        assert not rows["done"].any()
        fresh += int(done.sum())
    assert fresh > 1000
