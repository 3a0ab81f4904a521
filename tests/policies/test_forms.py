"""Forms of policies: actors behind transforms, objects that hold a policy, names; arguments in the wrong order."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Bernoulli, Independent
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import (
    CatFrames,
    Compose,
    ObservationNorm,
    RewardSum,
    StepCounter,
    Transform,
    VecNormV2,
)
from torchrl.modules import ProbabilisticActor

import trackmdp as tm
from tests.helpers import small_world
from trackmdp.errors import UserError
from trackmdp.policies.forms import DrawsError

WORLD = small_world(t_max=1)
WIDTH = 9 + 3 + 18


def actor(seed: int = 0) -> TensorDictSequential:
    """An actor that reads `observation`, as one behind `ObservationVector` does."""
    torch.manual_seed(seed)
    net = TensorDictModule(nn.Linear(WIDTH, 9), ["observation"], ["logits"])
    return TensorDictSequential(net, TensorDictModule(lambda x: x > 0, ["logits"], ["action"]))


CHAINS: dict[str, Callable[[], Transform]] = {
    "vector": tm.ObservationVector,
    "norm": lambda: Compose(
        tm.ObservationVector(), ObservationNorm(loc=0.1, scale=2.0, in_keys=["observation"])
    ),
    "norm that learns": lambda: Compose(
        tm.ObservationVector(), VecNormV2(in_keys=["observation"], reduce_batch_dims=True)
    ),
    "others": lambda: Compose(StepCounter(), tm.ObservationVector(), RewardSum()),
}


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size")
@pytest.mark.parametrize("name", CHAINS)
def test_an_actor_behind_transforms_is_the_policy_that_acts_in_the_environment(name: str) -> None:
    env = TransformedEnv(tm.TrackEnv(WORLD, 40, seed=1), CHAINS[name]())
    mine = actor()
    with torch.no_grad():
        env.rollout(20, mine, break_when_any_done=False)
        if name == "norm that learns":
            env.transform[1].freeze()
        frames = env.rollout(40, mine, break_when_any_done=False).reshape(-1)
    policy = tm.Policy.from_module(WORLD, mine, transform=env.transform)
    # After t_max + 1 misses the safe action replaces any choice, and a table has no row for it.
    free = frames[frames["steps_since_detection"] <= 1]
    states = free.select("last_cell", "steps_since_detection", "action_history")
    assert len(torch.unique(free["observation"], dim=0)) > 12
    assert torch.equal(policy(states)["action"], free["action"])


def test_a_transform_that_keeps_a_state_has_no_value() -> None:
    frames = Compose(tm.ObservationVector(), CatFrames(N=2, dim=-1, in_keys=["observation"]))
    with pytest.raises(DrawsError, match="reads observation of CatFrames"):
        tm.Policy.from_module(WORLD, actor(), transform=frames)


def test_an_actor_that_reads_the_vector_is_valued_and_simulated() -> None:
    """Bare, behind an `ObservationVector` of its own, and as its table."""
    mine = actor()
    values = {
        tm.evaluate(WORLD, each).aihtr
        for each in (
            mine,
            TensorDictSequential(tm.ObservationVector(), mine),
            tm.Policy.from_module(WORLD, mine),
        )
    }
    assert len(values) == 1
    one, other = (
        tm.simulate(WORLD, each, 5) for each in (mine, tm.Policy.from_module(WORLD, mine))
    )
    assert np.array_equal(one.reward, other.reward)


def test_an_actor_that_draws_floats_is_the_mixture_it_draws_from() -> None:
    """Without the weights of the history, on which an exact value may not depend."""
    net = nn.Linear(WIDTH, 9)
    nn.init.zeros_(net.weight[:, 12:])
    drawing = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=lambda logits: Independent(Bernoulli(logits=logits), 1),
    )
    exact = tm.evaluate(WORLD, drawing).aihtr
    found = tm.simulate(WORLD, drawing, 2000).figures().aihtr
    assert abs(found.mean - exact) < 4 * found.standard_error
    env = TransformedEnv(tm.TrackEnv(WORLD, 4), tm.ObservationVector())
    assert env.rollout(5, drawing, break_when_any_done=False)["action"].dtype == torch.float32


def test_the_vector_is_called_alone_with_a_world() -> None:
    state = {
        "last_cell": torch.tensor([4]),
        "steps_since_detection": torch.tensor([0]),
        "action_history": torch.zeros(1, 2, 9, dtype=torch.bool),
    }
    made = tm.ObservationVector(WORLD, out_key="seen")(TensorDict(state, [1]))["seen"]
    assert made.nonzero()[:, 1].tolist() == [4, 9]
    with pytest.raises(UserError, match="without an environment, expected a world"):
        tm.ObservationVector()(TensorDict(state, [1]))


def test_what_holds_a_policy_is_one() -> None:
    best = tm.solve(WORLD)
    table = best.policy.dense()
    held = [best, SimpleNamespace(policy=best.policy), table, torch.as_tensor(table), "optimal"]
    assert {tm.evaluate(WORLD, each).aihtr for each in held} == {best.lower}
    assert len({float(tm.simulate(WORLD, each, 3).reward.sum()) for each in held}) == 1


def test_a_model_of_stable_baselines_is_its_mode() -> None:
    class Model:
        """All that `evaluate` asks of one."""

        observation_space: Any = SimpleNamespace(spaces={"last_cell": torch.zeros(())})

        def predict(self, seen: dict[str, Any], deterministic: bool) -> tuple[Any, None]:
            assert deterministic
            assert [*seen] == ["last_cell"]  # no other key has a place in its space
            near = np.abs(np.arange(9) - seen["last_cell"][:, None]) <= 1
            return near.astype(np.int8), None

    cells = torch.arange(9)
    same = tm.Policy.from_function(WORLD, lambda x, n, h: (cells - x[:, None]).abs() <= 1)
    assert tm.evaluate(WORLD, Model()).aihtr == tm.evaluate(WORLD, same).aihtr
    Model.observation_space = SimpleNamespace(shape=(9,))
    with pytest.raises(UserError, match="reads a SimpleNamespace, expected a Dict of last_cell"):
        tm.evaluate(WORLD, Model())


def test_a_model_of_stable_baselines_is_given_the_mask_and_refused_where_it_reads_more() -> None:
    class Model:
        def __init__(self, world: Any) -> None:
            self.observation_space = SimpleNamespace(spaces=tm.TrackEnv(world).observation_spec)

        def predict(self, seen: dict[str, Any], deterministic: bool) -> tuple[Any, None]:
            return seen["action_mask"], None

    cost = np.full(9, 0.1)
    cost[3] = np.nan
    world = tm.make_world("random_walk", size=3, cost=cost)
    assert tm.evaluate(world, Model(world)).aihtr == tm.evaluate(world, "all_on").aihtr
    with pytest.raises(UserError, match=r"action_history of .*9\], got .*16\], .*another grid"):
        tm.evaluate(tm.make_world("random_walk", size=4, cost=0.1), Model(world))
    limited = tm.make_world("random_walk", size=3, max_steps=5)
    for call in (tm.evaluate, lambda *given: tm.simulate(*given, 1)):
        with pytest.raises(UserError, match="policy: the model reads step_count, expected last_ce"):
            call(limited, Model(limited))


class Together:
    """As a model of Stable-Baselines3 that was trained in `TrackGym`: the sensors around all targets that are there."""

    def __init__(self, group: tm.Group) -> None:
        self.observation_space = SimpleNamespace(spaces=tm.TrackEnv(group).observation_spec)

    def predict(self, seen: dict[str, Any], deterministic: bool) -> tuple[Any, None]:
        assert deterministic
        near = np.abs(np.arange(9) - seen["last_cell"][..., None]) <= 1
        return (near & seen["present"][..., None]).any(1).astype(np.int8), None


@pytest.mark.parametrize("how", ["Stable-Baselines3", "TorchRL"])
def test_a_model_that_reads_what_is_shown_of_all_targets_is_valued(how: str) -> None:
    group, cells = tm.Group([WORLD] * 2), torch.arange(9)
    same = tm.Policy.from_function(WORLD, lambda x, n, h: (cells - x[:, None]).abs() <= 1)

    def act(last: torch.Tensor, here: torch.Tensor) -> torch.Tensor:
        return (((cells - last[..., None]).abs() <= 1) & here[..., None]).any(1).float()

    actor = TensorDictModule(act, in_keys=["last_cell", "present"], out_keys=["action"])
    model = actor if how == "TorchRL" else Together(group)
    union = tm.evaluate(group, same, merge="union", width=0.05)
    assert np.array_equal(tm.evaluate(group, model, width=0.05).totals, union.totals)
    assert len(tm.simulate(group, model, 3)) == 3


def test_a_model_for_all_targets_is_refused_where_it_draws_or_reads_more() -> None:
    limited = tm.Group([tm.make_world("random_walk", size=3, max_steps=5)] * 2)
    with pytest.raises(UserError, match="policy: the model reads step_count, expected last_cell"):
        tm.evaluate(limited, Together(limited))
    group = tm.Group([WORLD] * 2)
    with pytest.raises(UserError, match=r"reads last_cell of .*2\], got \[3\], of other targets"):
        tm.evaluate(tm.Group([WORLD] * 3), Together(group))
    for act, name, message in (
        (lambda here: torch.rand(len(here), 9) < 0.5, "action", "draws at random"),
        (lambda here: here, "action", r"its action: expected .* \[9, 9\], got bool \[9, 2\]"),
        (lambda here: here, "set", "the module writes no action"),
    ):
        module = TensorDictModule(act, in_keys=["present"], out_keys=[name])
        with pytest.raises(UserError, match=f"policy: {message}"):
            tm.evaluate(group, module)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: tm.evaluate(tm.Policy.none(WORLD), WORLD),
            "evaluate: the first argument is a Pol",
        ),
        (lambda: tm.simulate(tm.TrackEnv(WORLD), "none", 1), "simulate: the first .* a TrackEnv"),
        (lambda: tm.train(None), "train: the first argument is a NoneType, expected a world"),
        (lambda: tm.solve("heading"), "solve: the first argument is a str, expected a world"),
        (lambda: tm.TrackEnv(tm.World), "TrackEnv: the first argument is a World, expected"),
        (lambda: tm.train(WORLD, callbacks=[print]), "callbacks: a builtin_function_or_method"),
        (lambda: tm.evaluate(WORLD, WORLD), "policy: a World, expected a Policy"),
        (lambda: tm.evaluate(WORLD, "qmpd"), "baseline=qmpd: expected one of"),
        (lambda: tm.evaluate(WORLD, torch.ones(3, 3)), "policy"),
        (
            lambda: tm.evaluate(WORLD, lambda x: x),
            "policy: <lambda>: expected a function of last_c",
        ),
        (
            lambda: tm.evaluate(WORLD, torch.nn.Linear(3, 4)),
            "policy: Linear: expected a function of last_c",
        ),
        (
            lambda: tm.evaluate(WORLD, lambda x, n, h: None),
            "its action: expected 0 or 1 .* NoneType",
        ),
        (
            lambda: tm.Policy.from_function(lambda x, n, h: h, WORLD),
            "policy: the first argument is a function, expected a world",
        ),
        (lambda: tm.train(WORLD, log=["tensorboard"]), "log=.*tensorboard.*: expected folder"),
    ],
)
def test_wrong_arguments_are_refused_in_a_line(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(UserError, match=message) as refused:
        call()
    assert "\n" not in str(refused.value)
