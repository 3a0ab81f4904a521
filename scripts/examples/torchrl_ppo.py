"""PPO written by the user on `TrackEnv` with TorchRL's own parts; the result is valued exactly."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Bernoulli, Independent
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import trackmdp as tm

KEYS = ["last_cell", "steps_since_detection"]
FRAMES, BATCH = 60_000, 2_000


class Net(nn.Module):
    """One linear layer over (last cell, steps since detection)."""

    def __init__(self, world: tm.World, outputs: int, bias: float) -> None:
        super().__init__()
        self.clocks = world.t_max + 2
        self.table = nn.Embedding(world.num_cells * self.clocks, outputs)
        nn.init.constant_(self.table.weight, bias)

    def forward(self, last_cell: Tensor, steps_since_detection: Tensor) -> Tensor:
        """`[..., outputs]`."""
        return self.table(last_cell * self.clocks + steps_since_detection)


def subset(logits: Tensor) -> Independent:
    """Each sensor on by itself, with the probability sigmoid(logit)."""
    return Independent(Bernoulli(logits=logits), 1)


def main(frames: int = FRAMES) -> None:
    """Train, then print the exact value beside the optimum."""
    torch.manual_seed(0)
    world = tm.make_world("random_walk", size=4, cost=0.1, exit_probability=0.05)
    actor = ProbabilisticActor(
        TensorDictModule(Net(world, world.num_cells, -1.0), in_keys=KEYS, out_keys=["logits"]),
        in_keys=["logits"], distribution_class=subset, return_log_prob=True,
    )  # fmt: skip
    critic = ValueOperator(Net(world, 1, 0.0), in_keys=KEYS)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.003)
    advantage = GAE(gamma=0.9, lmbda=0.9, value_network=critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.05)
    env = tm.TrackEnv(world, 50, seed=0)
    budget = {
        "frames_per_batch": BATCH,
        "total_frames": frames,
        "auto_register_policy_transforms": False,
    }
    for batch in Collector(env, actor, **budget):
        for _ in range(4):
            advantage(batch)
            parts = loss(batch.reshape(-1))
            optimizer.zero_grad()
            (parts["loss_objective"] + parts["loss_critic"] + parts["loss_entropy"]).backward()
            optimizer.step()
    drawing, best = tm.evaluate(world, actor).aihtr, tm.solve(world).upper
    mode = tm.evaluate(world, tm.Policy.from_module(world, actor)).aihtr
    print(f"PPO as it draws {drawing:.3f}, its mode {mode:.3f}, optimum {best:.3f}")


if __name__ == "__main__":
    main()
