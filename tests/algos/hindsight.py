"""Runs of the learners from hindsight, small enough for a test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from tests.helpers import algorithm, collect, small_world
from trackmdp.algos.actor_loss import ActorLoss, Decision, Poisson, PolicyGradient, Surrogate
from trackmdp.algos.gains import Credit
from trackmdp.algos.hindsight_loss import HindsightLoss
from trackmdp.config.learning import ScheduleConfig
from trackmdp.policies.policy import as_policy
from trackmdp.solvers import optimal
from trackmdp.solvers.evaluate import evaluate
from trackmdp.solvers.evaluation import regret_per_step
from trackmdp.world.model import World

SHORT = (
    "algo.updates=30",
    "algo.updates_per_iteration=10",
    "algo.batch_size=512",
    "algo.hidden=16",
)
SOLVES = (
    "algo.updates=300",
    "algo.updates_per_iteration=100",
    "algo.batch_size=2048",
    "algo.hidden=32",
)

BETA = ScheduleConfig(start=0.3, end=0.3, begin=0.0, until=1.0)
FORMS: dict[str, Callable[[], ActorLoss]] = {
    "decision": Decision,
    "policy gradient": lambda: PolicyGradient(BETA),
    "surrogate": lambda: Surrogate(BETA, clip_epsilon=0.2, minibatches=2, generator=None),
    "poisson": Poisson,
}


def batches(world: World, count: int = 16, *, envs: int = 32, seed: int = 0) -> list[Any]:
    """What the collector hands over with `tests.helpers.algorithm`'s budget."""
    time = 8 * count
    return list(
        collect(world, algorithm("hindsight", world).policy, envs, time, seed=seed).split(8, dim=1)
    )


def learn(world: World, data: list[Any], *overrides: str, name: str = "hindsight") -> Any:
    learner = algorithm(name, world, *overrides)
    for batch in [*data, *[None] * (learner.iterations - len(data))]:
        learner.step(batch)
    return learner


def policy(learner: Any, world: World) -> Any:
    return as_policy(world, learner.actor)


def assert_it_learns(name: str, words: tuple[str, ...], t_max: int) -> None:
    world = small_world(t_max=t_max, exit_probability=0.02)
    learner = learn(world, batches(world, 32), *SOLVES, "algo.total_frames=8192", *words, name=name)
    best = optimal.solve(world, nodes=1_000_000)
    assert regret_per_step(best.upper, evaluate(world, policy(learner, world))) < 0.01


def assert_same(first: Any, second: Any) -> None:
    """Equal to the last bit, through all containers."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_same(first[key], second[key])
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    elif isinstance(first, Tensor | TensorDict):
        assert bool((first == second).all())
    else:
        assert first == second


def total(loss: HindsightLoss, cells: Tensor, on: Tensor, blend: float) -> dict[str, Tensor]:
    """The losses, each under the name of the net that it trains: those of all parts added up."""
    losses: dict[str, Tensor] = {}
    for part in loss.parts(cells, on, blend):
        losses |= {
            name: losses[name] + each if name in losses else each for name, each in part.items()
        }
    return losses


def chain_returns(
    hits: Tensor,
    inside: Tensor,
    set_cost: Tensor,
    value: Tensor,
    *,
    safe_cost: float,
    discount: float,
    safe: float = 1.0,
    missed: float = 0.0,
) -> Tensor:
    """`Credit.returns`, a target that the safe action misses being worth `missed` in any cell."""
    credit = Credit(discount, safe_cost, safe - safe_cost, torch.tensor([safe, 0.0]))
    end = torch.zeros(value.shape[1], dtype=torch.int64)
    return credit.returns(hits, inside, set_cost, value, end, torch.tensor([missed]))
