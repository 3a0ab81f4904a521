"""Frames of TorchRL's collector as in training, beside a plain loop, with policies from free to a network."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

import trackmdp as tm
from benchmarks.clock import rate
from benchmarks.env import STEPS, RandomSubset, Steps
from benchmarks.words import Row, world_of


def rows(
    words: Mapping[str, str],
    batch_sizes: tuple[int, ...] = (64, 1024),
    seconds: float = 2.0,
    seed: int = 0,
    device: str = "cpu",
) -> Iterator[Row]:
    """One row for each policy and number of environments.

    `times_loop` is the CPU time over that of a loop of the same steps which stores nothing, `times_stored` over that of
    a loop which puts all steps in one batch, as the collector does.
    """
    world = world_of(words)
    for name, make in POLICIES.items():
        for envs in batch_sizes:
            env, policy = make(world, tm.TrackEnv(world, envs, seed=seed, device=device), seed)
            loops = [
                rate(Steps(env, policy, store=store), seconds, device) for store in (False, True)
            ]
            collector = Collector(
                env,
                policy,
                frames_per_batch=STEPS * envs,
                total_frames=-1,  # without end: `seconds` decides
                # As in training (`trackmdp/training/collect.py`).
                track_traj_ids=False,
                use_buffers=False,
                return_same_td=True,
                auto_register_policy_transforms=False,
                trust_policy=True,
                **dict.fromkeys(("env_device", "policy_device", "storing_device"), env.device),
            )
            batches = iter(collector)
            figures = rate(lambda batches=batches: next(batches).numel(), seconds, device)
            collector.shutdown()
            times = [figures["cpu_us_each"] / loop["cpu_us_each"] for loop in loops]
            over = dict(zip(("times_loop", "times_stored"), times, strict=True))
            yield {"policy": name, "envs": envs, **figures, **over}


def _random(world: tm.World, env: tm.TrackEnv, seed: int) -> tuple[Any, Any]:  # noqa: ARG001
    return env, RandomSubset(env, seed)


def _all_on(world: tm.World, env: tm.TrackEnv, seed: int) -> tuple[Any, Any]:  # noqa: ARG001
    return env, tm.Policy.all_on(world)


def _network(world: tm.World, env: tm.TrackEnv, seed: int) -> tuple[Any, Any]:  # noqa: ARG001
    shown = TransformedEnv(env, tm.ObservationVector())
    width = shown.observation_spec["observation"].shape[-1]
    sensors = env.action_spec.shape[-1]
    net = nn.Sequential(nn.Linear(width, 128), nn.ReLU(), nn.Linear(128, sensors), _Positive())
    return shown, TensorDictModule(net, in_keys=["observation"], out_keys=["action"]).to(env.device)


class _Positive(nn.Module):
    def forward(self, logits: Any) -> Any:
        return logits > 0


POLICIES: dict[str, Callable[[tm.World, tm.TrackEnv, int], tuple[Any, Any]]]
POLICIES = {"random": _random, "all_on": _all_on, "network": _network}
"""Name -> a function of world, environment and seed that returns the environment and the policy that acts in it."""
