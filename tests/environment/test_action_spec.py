"""Random sets of sensors within a budget, and their spec in TorchRL's hands."""

from __future__ import annotations

import copy
import pickle
from collections import Counter
from collections.abc import Callable
from functools import partial

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import Binary, Categorical, Composite
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.helpers import small_world
from trackmdp.environment.action_spec import at_most
from trackmdp.environment.env import TrackEnv


def env(budget: int | None = 2, rows: int = 4) -> TrackEnv:
    return TrackEnv(small_world().but(budget=budget), rows)


def spec(*shape: int, budget: int = 2, sensors: int = 9) -> Binary:
    kind = at_most(budget, sensors)
    return kind(shape=torch.Size((*shape, sensors)), dtype=torch.bool)


def sets(*on: list[int]) -> torch.Tensor:
    """`[*, 9]` bool, the sensors given on."""
    return torch.stack([torch.isin(torch.arange(9), torch.tensor(each)) for each in on])


ENVS: dict[str, Callable[[], EnvBase]] = {
    "bare": env,
    "a transform": lambda: TransformedEnv(env(), StepCounter()),
    "SerialEnv": lambda: SerialEnv(2, env),
    "ParallelEnv": lambda: ParallelEnv(2, env),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name == "ParallelEnv")) for name in ENVS],
)
def test_random_actions_keep_to_the_budget_in(name: str) -> None:
    made = ENVS[name]()
    try:
        check_env_specs(made)
        on = made.rollout(30, break_when_any_done=False)["action"].sum(-1)
    finally:
        made.close()
    assert set(on.unique().tolist()) == {0, 1, 2}


@pytest.mark.parametrize("made", [env, partial(SerialEnv, 2, env)])
def test_a_collector_without_a_policy_keeps_to_the_budget(made: Callable[[], EnvBase]) -> None:
    frames = {"frames_per_batch": 80, "total_frames": 80}
    collector = Collector(made(), None, **frames, auto_register_policy_transforms=False)
    on = torch.cat([batch["action"].sum(-1) for batch in collector])
    assert set(on.unique().tolist()) == {0, 1, 2}


@pytest.mark.parametrize("budgets", [(1, 2), (2, None), (None, 2)])
def test_environments_of_several_budgets_keep_to_each(budgets: tuple[int | None, ...]) -> None:
    several = SerialEnv(2, [partial(env, budget) for budget in budgets])
    most = several.rollout(40, break_when_any_done=False)["action"].sum(-1).amax((1, 2))
    for found, budget in zip(most.tolist(), budgets, strict=True):
        assert found == budget if budget else found > 2


def test_drawn_are_sets_of_the_budget_each_sensor_of_which_is_on_by_a_fair_coin() -> None:
    """Of three sensors and a budget of 2: none 1/4, each single one 1/6, each pair 1/12."""
    drawn = spec(120_000, sensors=3).rand()
    counts = Counter(map(tuple, drawn.int().tolist()))
    chance = {0: 1 / 4, 1: 1 / 6, 2: 1 / 12}
    assert len(counts) == 7
    for bits, count in counts.items():
        assert count / 120_000 == pytest.approx(chance[sum(bits)], abs=0.006)


REBUILT: dict[str, tuple[Callable[[Binary], Binary], tuple[int, ...]]] = {
    "clone": (lambda each: each.clone(), (4, 3, 9)),
    "copy": (copy.copy, (4, 3, 9)),
    "deepcopy": (copy.deepcopy, (4, 3, 9)),
    "pickle": (lambda each: pickle.loads(pickle.dumps(each)), (4, 3, 9)),  # noqa: S301
    "to a device": (lambda each: each.to("meta"), (4, 3, 9)),
    "to a dtype": (lambda each: each.to(torch.int8), (4, 3, 9)),
    "expand": (lambda each: each.expand(2, 4, 3, 9), (2, 4, 3, 9)),
    "reshape": (lambda each: each.reshape(12, 9), (12, 9)),
    "view": (lambda each: each.view(2, 6, 9), (2, 6, 9)),
    "flatten": (lambda each: each.flatten(0, 1), (12, 9)),
    "unflatten": (lambda each: each.unflatten(0, (2, 2)), (2, 2, 3, 9)),
    "unsqueeze": (lambda each: each.unsqueeze(0), (1, 4, 3, 9)),
    "squeeze": (lambda each: each.unsqueeze(1).squeeze(1), (4, 3, 9)),
    "index": (lambda each: each[1], (3, 9)),
    "slice": (lambda each: each[1:, :2], (3, 2, 9)),
    "unbind": (lambda each: each.unbind(1)[0], (4, 9)),
    "index_select": (lambda each: torch.index_select(each, 0, torch.tensor([2])), (1, 3, 9)),
    "stack": (lambda each: torch.stack([each, each.clone()], 1), (4, 2, 3, 9)),
    "Composite": (lambda each: Composite({"a": each}, shape=(4,)).clone()[2]["a"], (3, 9)),
}


@pytest.mark.parametrize("name", REBUILT)
def test_a_spec_that_is_rebuilt_keeps_its_budget(name: str) -> None:
    rebuild, shape = REBUILT[name]
    made = rebuild(spec(4, 3))
    assert made.shape == shape
    assert made == at_most(2, 9)(shape=made.shape, device=made.device, dtype=made.dtype)
    on = made.to("cpu").rand((50,))
    assert on.dtype == made.dtype and int(on.sum(-1).max()) == 2


def test_specs_are_equal_by_their_budgets() -> None:
    free = Binary(shape=(4, 9), dtype=torch.bool)
    assert spec(4) == spec(4)
    assert spec(4) != spec(4, budget=3) and spec(4) != free and free != spec(4)
    assert isinstance(env().action_spec, Binary)
    for limit in (None, 9, 10**30):
        assert type(env(limit).action_spec) is Binary
    assert not isinstance(Categorical(2, (4, 9)), type(spec(4))) and not isinstance(3, Binary)
    assert "AtMost2" in repr(env().action_spec)


def test_what_is_in_it_and_what_is_projected() -> None:
    """The first sensors that are on are kept."""
    one, off, three = sets([4]), sets([]), sets([2, 5, 7])
    both = torch.cat([one, three])
    assert spec(1).is_in(one) and spec(1).is_in(off) and spec(1).is_in(sets([2, 5]))
    assert not spec(1).is_in(three) and not spec(2).is_in(both)
    assert not spec(1).is_in(one.int()) and not spec(2).is_in(one)
    with pytest.raises(AssertionError):
        spec(2).assert_is_in(both)
    assert torch.equal(spec(2).project(both.clone()), torch.cat([one, sets([2, 5])]))
    floats = torch.tensor([0.2, 3.0, 0.9, -1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert spec().project(floats).tolist() == [0, 1, 1, 0, 0, 0, 0, 0, 0]
    assert not spec(4).zeros().any() and spec(4).is_in(spec(4).zeros())
    assert spec(4).ones().all()  # as with TorchRL's own specs, whether it is in the spec or not


def test_a_shape_whose_last_dimension_is_not_the_sensors_knows_no_budget() -> None:
    for made in (spec(4).unsqueeze(-1), spec(4).flatten(0, 1)):
        assert type(made) is Binary


def test_no_sensor_at_all() -> None:
    assert not env(0).rollout(5)["action"].any()
