"""From a world and a policy to a stream of batches: TorchRL's collectors, set up once."""

from __future__ import annotations

import signal
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector

from trackmdp.config.learning import CollectorConfig, MultiAsyncConfig, MultiSyncConfig, RayWorkersConfig
from trackmdp.seeding import derive
from trackmdp.world.env import TrackEnv
from trackmdp.world.tracks import Problem

__all__ = ["collector_state", "load_collector_state", "make_collector"]


def make_collector(
    world: Problem,
    policy: TensorDictModuleBase,
    cfg: CollectorConfig,
    *,
    seed: int,
    env_device: torch.device,
    device: torch.device,
    done: int = 0,
) -> BaseCollector:
    """A collector of batches `[B, time]` on `device` (the learner's); its frames are env steps.

    The environment's own `_step_and_maybe_reset` and the flags below make the collector as fast as a loop by hand.
    Of `cfg.total_frames`, made up to whole batches, the `done` frames of an earlier process are not collected again.
    """
    env: dict[str, Any] = {"num_envs": cfg.envs, "seed": seed, "device": env_device}
    common: dict[str, Any] = {
        "frames_per_batch": cfg.frames_per_batch,
        "total_frames": -(-(cfg.total_frames - done) // cfg.frames_per_batch) * cfg.frames_per_batch,
        "auto_register_policy_transforms": False,
        "env_device": env_device,
        "policy_device": device,
        "storing_device": device,
        "trust_policy": True,  # a policy without parameters (all sensors on) lives on any device
    }
    if isinstance(cfg, (MultiSyncConfig, MultiAsyncConfig)):
        workers = [partial(_worker_env, world, f"{worker}-{done}", env) for worker in range(cfg.workers)]
        kind = MultiSyncCollector if isinstance(cfg, MultiSyncConfig) else MultiAsyncCollector
        return kind(workers, policy, num_threads=torch.get_num_threads(), num_sub_threads=cfg.threads, **common)
    if isinstance(cfg, RayWorkersConfig):
        from trackmdp.training import on_ray

        places = [f"{worker}-{done}" for worker in range(cfg.workers)]
        return on_ray.make_collector(
            [partial(_remote_env, world, at, env, cfg.threads) for at in places], policy, cfg, common
        )
    return Collector(TrackEnv(world, **env), policy, track_traj_ids=False, **common)


def _worker_env(world: Problem, worker: str, env: dict[str, Any]) -> TrackEnv:
    """Built in a worker process: its own stream for the targets, and for the actions sampled there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the workers as well; the learner tells them to end
    torch.manual_seed(derive(env["seed"], "torch", worker))
    return TrackEnv(world, stream=f"world-{worker}", **env)


def _remote_env(world: Problem, worker: str, env: dict[str, Any], threads: int) -> TrackEnv:
    torch.set_num_threads(threads)
    torch.manual_seed(derive(env["seed"], "torch", worker))
    return TrackEnv(world, stream=f"world-{worker}", **env)


def collector_state(collector: BaseCollector) -> dict[str, Any] | None:
    """Where collecting stands between two batches: the rows in mid-episode and the environment's generators.

    None for collectors in worker processes, whose environments cannot be asked: they start new episodes on resume.
    """
    if not isinstance(collector, Collector):
        return None
    return {
        "carrier": collector._carrier.clone().to_dict(),
        "environment": collector.env.generator_state(),
    }


def load_collector_state(collector: Collector, state: dict[str, Any]) -> None:
    """Go on where `collector_state` was taken; call before the first batch."""
    rows = TensorDict.from_dict(state["carrier"], batch_size=collector._carrier.batch_size)
    collector._carrier = collector._carrier.empty().update(rows)
    collector.env.set_generator_state(state["environment"])
