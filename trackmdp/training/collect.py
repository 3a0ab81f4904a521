"""From a world and a policy to a stream of batches: TorchRL's collectors, set up once."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector

from trackmdp.config.learning import Collector as CollectorConfig
from trackmdp.config.learning import MultiAsync, MultiSync
from trackmdp.seeding import derive
from trackmdp.world.env import TrackEnv
from trackmdp.world.model import World

__all__ = ["make_collector"]


def make_collector(
    world: World,
    policy: TensorDictModuleBase,
    cfg: CollectorConfig,
    *,
    seed: int,
    max_steps: int | None,
    env_device: torch.device,
    device: torch.device,
) -> BaseCollector:
    """A collector of batches `[B, time]` on `device` (the learner's); its frames are env steps.

    The environment's own `_step_and_maybe_reset` and the flags below make the collector as fast as a loop by hand.
    """
    env: dict[str, Any] = {"num_envs": cfg.envs, "seed": seed, "max_steps": max_steps, "device": env_device}
    common: dict[str, Any] = {
        "frames_per_batch": cfg.frames_per_batch,
        "total_frames": cfg.total_frames,
        "auto_register_policy_transforms": False,
        "env_device": env_device,
        "policy_device": device,
        "storing_device": device,
        "trust_policy": True,  # a policy without parameters (all sensors on) lives on any device
    }
    if isinstance(cfg, (MultiSync, MultiAsync)):
        workers = [partial(_worker_env, world, worker, env) for worker in range(cfg.workers)]
        kind = MultiSyncCollector if isinstance(cfg, MultiSync) else MultiAsyncCollector
        return kind(workers, policy, num_threads=torch.get_num_threads(), num_sub_threads=cfg.threads, **common)
    return Collector(TrackEnv(world, **env), policy, track_traj_ids=False, **common)


def _worker_env(world: World, worker: int, env: dict[str, Any]) -> TrackEnv:
    """Built in a worker process: its own stream for the targets, and for the actions sampled there."""
    torch.manual_seed(derive(env["seed"], "torch", worker))
    return TrackEnv(world, stream=f"world-{worker}", **env)
