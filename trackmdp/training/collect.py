"""From a world and a policy to a stream of batches: TorchRL's collectors, set up once."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any, TypeAlias

import torch
from tensordict.nn import TensorDictModuleBase

from trackmdp.config import TrainConfig
from trackmdp.config.learning import CollectorConfig, WorkersConfig
from trackmdp.config.registry import maker
from trackmdp.environment.env import TrackEnv
from trackmdp.errors import RunError, message_of
from trackmdp.machine import make_device
from trackmdp.seeding import seed_global
from trackmdp.solvers.workers import end_with_parent, starting
from trackmdp.world.group import Subject

with warnings.catch_warnings():
    # TorchRL 0.14.1 warns of its own classes while it is imported: with `python -W error` nothing could be learned.
    warnings.simplefilter("ignore", DeprecationWarning)
    from torchrl import collectors as collectors

MakeEnv: TypeAlias = "partial[TrackEnv]"
"""Makes the environments that are stepped together; `stream` is the one argument left open."""


def make_collector(
    cfg: TrainConfig,
    problem: Subject,
    policy: TensorDictModuleBase,
    device: torch.device,
    *,
    done: int = 0,
) -> collectors.BaseCollector:
    """The source of the frames that are left, from the config's collector.

    Args:
        cfg: of the run.
        problem: the world or the tracks.
        policy: acts, on `device`.
        device: the learner's, where the batches end up.
        done: of `total_frames`, made up to whole batches, so many were collected by an earlier process.
    """
    chosen = cfg.collector
    place, batch = make_device(chosen.device, "collector.device"), chosen.frames_per_batch
    env = partial(TrackEnv, problem, chosen.envs, seed=cfg.seed, device=place)
    # With these flags, and the environment's own `_step_and_maybe_reset`, TorchRL's collectors are as fast as a loop by
    # hand.
    common = {
        "frames_per_batch": batch,
        # The rest, rounded up to whole batches: 100,000 frames in batches of 30,000 are 120,000, or 60,000 where
        # 60,000 are done. To TorchRL a negative number is no limit.
        "total_frames": max(-(-(chosen.total_frames - done) // batch), 0) * batch,
        # True would wrap the environment in an InitTracker: a transformed environment does not call the environment's
        # own `_step_and_maybe_reset`, and is slower. Left unset, TorchRL warns.
        "auto_register_policy_transforms": False,
        "env_device": place,
        "policy_device": device,
        "storing_device": device,
        "trust_policy": True,  # a policy without parameters (all sensors on) lives on any device
    }
    return maker(chosen)(env, policy, chosen, common, done)


def single(
    env: MakeEnv,
    policy: TensorDictModuleBase,
    cfg: CollectorConfig,  # noqa: ARG001
    common: dict[str, Any],
    done: int,  # noqa: ARG001
) -> collectors.BaseCollector:
    """A collector of batches `[B, time]` in this process; its frames are env steps.

    Args:
        env: makes the environments.
        policy: acts.
        cfg: options of the collector.
        common: arguments that all of TorchRL's collectors are given.
        done: frames that an earlier process collected.
    """
    # Trajectory numbers are read by no learner here, take a tenth of the collecting time, and would be one more state
    # to save. A buffer would be copied out for every batch: without one each batch is stacked once and is the caller's.
    once = {"use_buffers": False, "return_same_td": True}
    return collectors.Collector(env(), policy, track_traj_ids=False, **once, **common)


def _in_workers(
    kind: Callable[..., collectors.BaseCollector],
    env: MakeEnv,
    policy: TensorDictModuleBase,
    cfg: WorkersConfig,
    common: dict[str, Any],
    done: int,
) -> collectors.BaseCollector:
    """A collector of TorchRL's `kind` in worker processes; arguments as for `single`.

    Raises:
        RunError: a worker ended before it could collect.
    """
    threads = {"num_threads": torch.get_num_threads(), "num_sub_threads": cfg.threads}
    with ExitStack() as begun:
        with starting():
            try:
                made = kind(of_workers(_worker_env, env, cfg, done), policy, **threads, **common)
            except (RuntimeError, EOFError, OSError) as error:
                raise not_started(cfg, error) from error
            begun.callback(made.shutdown)
        begun.pop_all()  # no signal came meanwhile
        return made


def not_started(cfg: WorkersConfig, error: Exception) -> RunError:
    """The error for a worker that ended before it could collect."""
    # TorchRL's message has the worker's whole traceback from its second line on.
    return RunError(f"collector={cfg.name}: a worker did not start ({message_of(error)})")


# By default the batches of the workers are stacked, `[workers, B, time]`, which a learner would take for `[B, time]`.
multi_sync = partial(
    _in_workers, partial(collectors.MultiSyncCollector, cat_results=0, use_buffers=True)
)
"""Every batch is collected by all of the workers: `[B, time]`, their rows one after the other."""
multi_async = partial(_in_workers, collectors.MultiAsyncCollector)
"""Every batch is collected by the worker that has it ready."""


def of_workers(
    make: Callable[[MakeEnv, str], TrackEnv], env: MakeEnv, cfg: WorkersConfig, done: int
) -> list[Callable[[], TrackEnv]]:
    """Makes the environments of each worker."""
    # A resumed run's workers have streams of their own (`done`), not the first ones again.
    return [partial(make, env, f"{worker}-{done}") for worker in range(cfg.workers)]


def _worker_env(env: MakeEnv, worker: str) -> TrackEnv:
    # Ctrl-C, and a scheduler's SIGTERM, go to the workers as well. They must not die of them: the learner would wait
    # for an answer of theirs while it should save. It requests their end, and kills the others.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()
    return own_env(env, worker)


def own_env(env: MakeEnv, worker: str) -> TrackEnv:
    """Built in a worker process: its own stream for the targets, and for the actions sampled there."""
    seed_global(env.keywords["seed"], worker)
    return env(stream=f"world-{worker}")
