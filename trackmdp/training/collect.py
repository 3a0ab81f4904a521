"""From a world and a policy to a stream of batches: TorchRL's collectors, set up once."""

from __future__ import annotations

import signal
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector

from trackmdp.config import TrainConfig
from trackmdp.config.learning import CollectorConfig, RayWorkersConfig, WorkersConfig
from trackmdp.config.registry import maker
from trackmdp.errors import RunError
from trackmdp.imports import safe_children
from trackmdp.seeding import derive
from trackmdp.solvers.workers import end_with_parent
from trackmdp.training.devices import make_device
from trackmdp.world.env import TrackEnv
from trackmdp.world.group import Subject


def make_collector(
    cfg: TrainConfig,
    problem: Subject,
    policy: TensorDictModuleBase,
    device: torch.device,
    *,
    done: int = 0,
) -> BaseCollector:
    """The source of the frames that are left after the first `done`, from the config's collector."""
    return maker(cfg.collector)(
        problem, policy, cfg.collector, seed=cfg.seed, device=device, done=done
    )


def single(
    problem: Subject,
    policy: TensorDictModuleBase,
    cfg: CollectorConfig,
    *,
    seed: int,
    device: torch.device,
    done: int,
) -> BaseCollector:
    """A collector of batches `[B, time]` in this process; its frames are env steps.

    Args:
        problem: the world or the tracks.
        policy: acts, on `device`.
        cfg: frames, environments and their device.
        seed: of the run.
        device: the learner's, where the batches end up.
        done: of `cfg.total_frames`, made up to whole batches, so many were collected by an earlier process.
    """
    env, common = _env_options(cfg, seed), _common(cfg, device, done)
    # Trajectory numbers are read by no learner here, take a tenth of the collecting time, and would be one more state
    # to save. A buffer would be copied out for every batch: without one each batch is stacked once and is the caller's.
    once = {"use_buffers": False, "return_same_td": True}
    return Collector(TrackEnv(problem, **env), policy, track_traj_ids=False, **once, **common)


def _in_workers(
    kind: Callable[..., BaseCollector],
    problem: Subject,
    policy: TensorDictModuleBase,
    cfg: WorkersConfig,
    *,
    seed: int,
    device: torch.device,
    done: int = 0,
) -> BaseCollector:
    """A collector of TorchRL's `kind` in worker processes; arguments as for `single`.

    Raises:
        RunError: a worker ended before it could collect.
    """
    env = _env_options(cfg, seed)
    # A resumed run's workers have streams of their own (`done`), not the first ones again.
    workers = [
        partial(_worker_env, problem, f"{worker}-{done}", env) for worker in range(cfg.workers)
    ]
    threads = {"num_threads": torch.get_num_threads(), "num_sub_threads": cfg.threads}
    with safe_children():
        try:
            return kind(workers, policy, **threads, **_common(cfg, device, done))
        except (RuntimeError, EOFError, OSError) as error:
            # TorchRL's message has the worker's whole traceback from its second line on.
            reason = (str(error).splitlines() or [type(error).__name__])[0].strip()
            raise RunError(f"collector={cfg.name}: a worker did not start ({reason})") from error


multi_sync = partial(_in_workers, MultiSyncCollector)
"""Every batch is collected by all of the workers."""
multi_async = partial(_in_workers, MultiAsyncCollector)
"""Every batch is collected by the worker that has it ready."""


def ray(
    problem: Subject,
    policy: TensorDictModuleBase,
    cfg: RayWorkersConfig,
    *,
    seed: int,
    device: torch.device,
    done: int,
) -> BaseCollector:
    """A collector in the workers of a Ray cluster; arguments as for `single`.

    Raises:
        UserError: Ray is not installed, or there is no such cluster.
    """
    from trackmdp.training import on_ray

    env = _env_options(cfg, seed)
    workers = [
        partial(_remote_env, problem, f"{worker}-{done}", env, cfg.threads)
        for worker in range(cfg.workers)
    ]
    return on_ray.make_ray_collector(workers, policy, cfg, _common(cfg, device, done))


def _env_options(cfg: CollectorConfig, seed: int) -> dict[str, Any]:
    device = make_device(cfg.device, "collector.device")
    return {"batch_size": cfg.envs, "seed": seed, "device": device}


def _common(cfg: CollectorConfig, device: torch.device, done: int) -> dict[str, Any]:
    """The arguments that all of TorchRL's collectors are given.

    With these flags, and the environment's own `_step_and_maybe_reset`, they are as fast as a loop by hand.
    """
    return {
        "frames_per_batch": cfg.frames_per_batch,
        # The rest, rounded up to whole batches: 100,000 frames in batches of 30,000 are 120,000, or 60,000 where
        # 60,000 are done.
        "total_frames": -(-(cfg.total_frames - done) // cfg.frames_per_batch)
        * cfg.frames_per_batch,
        # True would wrap the environment in an InitTracker: a transformed environment does not call the environment's
        # own `_step_and_maybe_reset`, and is slower. Left unset, TorchRL warns.
        "auto_register_policy_transforms": False,
        "env_device": make_device(cfg.device, "collector.device"),
        "policy_device": device,
        "storing_device": device,
        "trust_policy": True,  # a policy without parameters (all sensors on) lives on any device
    }


def _worker_env(world: Subject, worker: str, env: dict[str, Any]) -> TrackEnv:
    """Built in a worker process: its own stream for the targets, and for the actions sampled there."""
    # Ctrl-C, and a scheduler's SIGTERM, go to the workers as well. They must not die of them: the learner would wait
    # for an answer of theirs while it should save. It requests their end, and kills the others.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()
    torch.manual_seed(derive(env["seed"], "torch", worker))
    return TrackEnv(world, stream=f"world-{worker}", **env)


def _remote_env(world: Subject, worker: str, env: dict[str, Any], threads: int) -> TrackEnv:
    torch.set_num_threads(threads)
    torch.manual_seed(derive(env["seed"], "torch", worker))
    return TrackEnv(world, stream=f"world-{worker}", **env)
