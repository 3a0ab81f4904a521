"""From an actor to its table: what it holds, and that asking does not disturb training."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

from tests.helpers import ALGORITHMS, algorithm, collect, headings, small_world
from trackmdp.episodes.simulate import simulate
from trackmdp.policies.policy import Policy, as_policy

STATE = ["last_cell", "steps_since_detection", "action_history"]


def scrambled(m: int) -> TensorDictModule:
    """A deterministic actor whose subset depends on the last cell, the misses, and every bit of the history."""

    def act(cell: torch.Tensor, n: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
        weights = torch.arange(1, history[0].numel() + 1)
        seen = (history.flatten(1) * weights).sum(-1) + 31 * cell + 17 * n
        return (
            (seen[:, None] + 1) * torch.tensor([71, 113, 137, 193, 239, 293, 379, 419, 431][:m])
        ) % 101 < 33

    return TensorDictModule(act, in_keys=STATE, out_keys=["action"])


def test_a_table_holds_the_sets_along_a_row_of_misses() -> None:
    world, actor = small_world(t_max=3), scrambled(9)
    chains = as_policy(world, actor).dense()
    assert chains.shape == (9, 4, 9)
    assert chains.dtype == np.bool_
    for cell in range(9):
        history = torch.zeros(1, 4, 9, dtype=torch.bool)
        for n in range(4):
            rows = {"last_cell": torch.tensor([cell]), "steps_since_detection": torch.tensor([n])}
            action = actor(TensorDict({**rows, "action_history": history.clone()}, [1]))["action"][
                0
            ]
            assert chains[cell, n].tolist() == action.tolist()
            history[0, n] = action
    assert len({chains[x, n].tobytes() for x in range(9) for n in range(4)}) > 20


@pytest.mark.parametrize("name", ["scrambled", *ALGORITHMS])
def test_a_table_holds_what_the_actor_does_in_the_environment(name: str) -> None:
    world = small_world(t_max=2)
    torch.manual_seed(0)
    if name == "scrambled":
        actor: Any = scrambled(9)
    else:
        actor = algorithm(name, world).actor
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.normal_(std=0.5)
    chains = torch.as_tensor(Policy.from_module(world, actor).dense())
    batch = collect(world, _evaluated(actor), 100, 40)
    free = batch["steps_since_detection"] <= 2
    followed = chains[batch["last_cell"][free], batch["steps_since_detection"][free]]
    assert torch.equal(batch["action"][free], followed)
    if name == "scrambled":
        assert {0, 1, 2} <= set(batch["steps_since_detection"].unique().tolist())


@pytest.mark.parametrize("known", [{"revealed": 8}, {"memory": "displacement_gap"}])
@pytest.mark.parametrize("name", ["a2c", "dqn"])
def test_an_actor_that_knows_more_than_the_cell_has_a_plan_for_each_key(
    name: str, known: dict[str, Any]
) -> None:
    world = headings(t_max=2, **known)
    torch.manual_seed(0)
    actor = algorithm(name, world).actor
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.normal_(std=0.5)
    policy = Policy.from_module(world, actor)
    plans = policy.dense()
    assert len(plans) == world.num_keys
    assert len({plan.tobytes() for plan in plans}) > world.num_keys // 2
    batch = collect(world, _evaluated(actor), 50, 30)
    free = batch["steps_since_detection"] <= 2
    followed = torch.as_tensor(plans)[batch["key"][free], batch["steps_since_detection"][free]]
    assert torch.equal(batch["action"][free], followed)
    acted = collect(world, policy, 50, 30)
    assert torch.equal(acted["action"][free], batch["action"][free])


def test_a_module_that_does_not_read_the_key_knows_the_cell() -> None:
    policy = as_policy(headings(revealed=8), scrambled(9))
    assert (policy.task.keyed, len(policy.dense())) == (False, 9)


def _evaluated(actor: Any) -> Callable[[TensorDict], TensorDict]:
    def act(rows: TensorDict) -> TensorDict:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return rows.set(
                "action", actor(rows.select(*STATE, *(["key"] if "key" in rows else [])))["action"]
            )

    return act


@pytest.mark.parametrize("name", ALGORITHMS)
def test_evaluating_does_not_disturb_training(name: str) -> None:
    """Three iterations with and without chains and simulations between them: the same bits in every tensor."""
    world, states = small_world(), []
    for evaluated in (False, True):
        torch.manual_seed(5)
        learner = algorithm(name, world)
        for seed in range(3):
            learner.step(collect(world, learner.policy, 32, 8, seed=seed))
            if evaluated:
                Policy.from_module(world, learner.actor)
                simulate(world, learner.actor, 20)
                simulate(world, learner.policy, 20)
        states.append(TensorDict.from_dict(_tensors(learner.state_dict())))
    assert (states[0] == states[1]).all()


def _tensors(state: Any, key: str = "") -> dict[str, torch.Tensor]:
    if isinstance(state, torch.Tensor):
        return {key: state}
    pairs = (
        state.items()
        if isinstance(state, dict)
        else enumerate(state)
        if isinstance(state, (list, tuple))
        else ()
    )
    found: dict[str, torch.Tensor] = {}
    for name, value in pairs:
        found |= _tensors(value, f"{key}/{name}")
    return found
