"""`actor=` and `critic=` of one's own in `tm.train`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import distributions, nn
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator

import trackmdp as tm
from tests.helpers import small_world
from trackmdp.errors import UserError

WORLD = small_world(exit_probability=0.05)
FEW = {"total_frames": 4096, "frames_per_batch": 2048, "envs": 64}


class Sensors(distributions.Independent):
    """A Bernoulli for each sensor, whose samples are floats."""

    def __init__(self, logits: torch.Tensor) -> None:
        super().__init__(distributions.Bernoulli(logits=logits), 1)

    @property
    def mode(self) -> torch.Tensor:
        return (self.base_dist.logits > 0).float()


def nets(distribution: type[distributions.Distribution] = Sensors) -> dict[str, Any]:
    """Actor and critic on one flat observation."""
    torch.manual_seed(0)
    env = tm.TrackEnv(WORLD, 2)
    size = tm.ObservationVector(WORLD)(env.reset())["observation"].shape[-1]
    actor = ProbabilisticActor(
        TensorDictModule(MLP(size, 9, num_cells=[16, 16]), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=distribution,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(size, 1, num_cells=[16]), in_keys=["observation"])
    return {"actor": actor, "critic": critic}


@pytest.mark.parametrize("algo", ["a2c", "ppo"])
def test_networks_of_ones_own_are_trained(algo: str) -> None:
    own = nets()
    before = [[weight.clone() for weight in net.parameters()] for net in own.values()]
    run = tm.train(WORLD, algo, **own, **FEW)
    for net, weights in zip(own.values(), before, strict=True):
        moved = (not torch.equal(*pair) for pair in zip(net.parameters(), weights, strict=True))
        assert all(moved)
    found = tm.Policy.from_module(WORLD, own["actor"])
    assert (found.sets != run.policy.sets).nnz == 0


def lazy() -> ValueOperator:
    """A critic that gets its sizes at the first call."""
    return ValueOperator(MLP(out_features=1, num_cells=[16]), in_keys=["observation"])


def test_one_of_them_may_be_the_algorithms() -> None:
    assert tm.train(WORLD, "a2c", actor=nets()["actor"], **FEW).evaluation.accuracy > 0


@pytest.mark.parametrize(
    ("algo", "given", "message"),
    [
        ("hindsight", {"actor": nets()["actor"]}, "actor: algo=hindsight makes its own"),
        ("dqn", {"critic": nets()["critic"]}, "critic: algo=dqn makes its own"),
        ("a2c", {"actor": nn.Linear(3, 3)}, "actor: a Linear, expected a module that writes"),
        ("a2c", {"critic": nets()["actor"]}, "critic: a ProbabilisticActor, expected a module"),
        ("a2c", {"critic": lazy()}, "critic: lazy layers, expected the sizes of all"),
        ("a2c", {"actor": nets()["actor"], "partition.block": 3}, "actor, critic: expected none"),
        (
            "ppo",
            {"actor": nets(distributions.Bernoulli)["actor"]} | FEW,
            "actor: action_log_prob [64, 32, 9], expected one number for a set, [64, 32]",
        ),
    ],
)
def test_networks_that_do_not_fit_are_one_line(
    algo: str, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError) as caught:
        tm.train(WORLD, algo, **given)
    assert str(caught.value).startswith(message)


def test_a_folder_could_not_be_resumed(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected None with actor"):
        tm.train(WORLD, "a2c", **nets(), folder=tmp_path / "a")
    assert not list(tmp_path.iterdir())
