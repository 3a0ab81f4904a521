"""What holds for every algorithm with a credit for each sensor."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.algos.hindsight import (
    SHORT,
    SOLVES,
    assert_it_learns,
    assert_same,
    batches,
    learn,
    policy,
)
from tests.helpers import algorithm, hop_world, later, small_world
from trackmdp.config import GROUPS
from trackmdp.config.credit import PerSensorConfig

PER_SENSOR = [
    name for name, schema in GROUPS["algo"].items() if issubclass(schema, PerSensorConfig)
]
VARIANTS = [
    *((name, ()) for name in PER_SENSOR if name != "hindsight"),
    ("ppo_per_sensor", ("algo.surrogate=sampled",)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "words"), VARIANTS)
def test_every_actor_loss_reaches_the_optimum_of_a_small_world(
    name: str, words: tuple[str, ...]
) -> None:
    assert_it_learns(name, words, t_max=2)


def test_ppo_draws_sets_only_where_it_is_asked_to() -> None:
    world = small_world()
    data = batches(world)
    drawn = [
        learn(world, data, *SHORT, *words, name="ppo_per_sensor")
        for words in ((), ("algo.surrogate=sampled",))
    ]
    expected, sampled = (learner._learner.loss.actor.weight for learner in drawn)
    assert not torch.equal(expected, sampled)


@pytest.mark.parametrize("name", ["hindsight", *later(["ppo_per_sensor"])])
def test_prices_are_per_cell(name: str) -> None:
    """The hopping target is worth sensing in the cheap cells only; r = 2, and a miss costs D in the end."""
    world = replace(hop_world(0, safe_cost=0.1), cost=np.array([0.1, 9.0, 0.1, 9.0]))
    sets = policy(learn(world, batches(world), *SOLVES, name=name), world).dense()
    assert sets[:, 0].astype(int).tolist() == [
        [0, 0, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 0],
        [1, 0, 0, 0],
    ]


@pytest.mark.parametrize("name", PER_SENSOR)
def test_the_unit_of_reward_does_not_matter(name: str) -> None:
    world = small_world()
    data = batches(world)
    scaled = replace(
        world, reward=world.reward * 1024, cost=world.cost * 1024, safe_cost=world.safe_cost * 1024
    )
    one, other = (
        policy(learn(each, data, *SHORT, name=name), each).dense() for each in (world, scaled)
    )
    assert np.array_equal(one, other)


@pytest.mark.parametrize("name", PER_SENSOR)
def test_reads_nothing_that_was_not_sensed(name: str) -> None:
    """Positions after steps that did not sense everything, and the reward, may be anything."""
    world = small_world()
    rng = torch.Generator().manual_seed(0)
    data = batches(world)
    for batch in data:
        batch["action"] &= torch.rand(*batch.shape, 1, generator=rng) < 0.8
    poisoned = [batch.clone() for batch in data]
    for batch in poisoned:
        missed = ~batch["action"].all(-1)
        for place in (batch, batch["next"]):
            place["action_history"] = torch.rand(place["action_history"].shape, generator=rng) < 0.5
        batch["next", "reward"] = torch.randn(batch["next", "reward"].shape, generator=rng)
        batch["next", "last_cell"][missed] = torch.randint(9, (int(missed.sum()),), generator=rng)
    clean, other = (
        learn(world, each, *SHORT, "algo.exchange=true", name=name) for each in (data, poisoned)
    )
    assert_same(clean.state_dict(), other.state_dict())
    assert np.array_equal(policy(clean, world).dense(), policy(other, world).dense())


RESUMED = [
    ("hindsight", (), 16),
    *later(("hindsight", (), saved_at) for saved_at in (3, 17)),
    *((*variant, 17) for variant in VARIANTS),
]


@pytest.mark.parametrize(("name", "words", "saved_at"), RESUMED)
def test_a_resumed_run_ends_as_the_unbroken_one(
    name: str, words: tuple[str, ...], saved_at: int
) -> None:
    world = small_world()
    data = batches(world)
    whole, begun = (
        learn(world, data, *SHORT, *words, name=name),
        algorithm(name, world, *SHORT, *words),
    )
    steps = [*data, *[None] * (begun.iterations - len(data))]
    for batch in steps[:saved_at]:
        begun.step(batch)
    file = io.BytesIO()
    torch.save(begun.state_dict(), file)
    file.seek(0)
    resumed = algorithm(name, world, *SHORT, *words, "seed=5")
    resumed.load_state_dict(torch.load(file, weights_only=True))
    for batch in steps[saved_at:]:
        resumed.step(batch)
    assert_same(whole.state_dict(), resumed.state_dict())
    assert np.array_equal(policy(whole, world).dense(), policy(resumed, world).dense())
