"""Collecting in the workers of a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector
from torchrl.collectors.distributed import RayCollector

from trackmdp.cluster import joining, ray_options
from trackmdp.config.learning import RayWorkersConfig
from trackmdp.environment.env import TrackEnv
from trackmdp.errors import message_of, require
from trackmdp.training.collect import MakeEnv, not_started, of_workers, own_env

_STORE = 2**30
"""Bytes for the batches on their way, of a cluster that is started here."""


def ray(
    env: MakeEnv,
    policy: TensorDictModuleBase,
    cfg: RayWorkersConfig,
    common: dict[str, Any],
    done: int,
) -> BaseCollector:
    """A collector of batches `[B, time]` with the rows of all workers, one after the other; arguments as for `single`.

    Raises:
        UserError: Ray is not installed, or there is no such cluster.
        RunError: a worker did not start.
    """
    require("ray", "ray", "collector=ray")
    # RayCollector has no such argument; the collectors that it makes in its workers have.
    register = common.pop("auto_register_policy_transforms")
    cores = max(1, round(cfg.workers * cfg.cpus_per_worker))
    made = None
    try:
        with _losing(), joining("collector.address", cfg.address):
            made = _Collector(
                of_workers(partial(_remote_env, cfg.threads), env, cfg, done),
                policy,
                sync=True,
                ray_init_config=ray_options(cfg.address, cores, _STORE) | {"log_to_driver": False},
                # Both are always given: TorchRL asks for 0.2 GPUs by default, and on a cluster without GPUs no worker
                # would ever start.
                remote_configs={"num_cpus": cfg.cpus_per_worker, "num_gpus": cfg.gpus_per_worker},
                collector_kwargs={
                    "auto_register_policy_transforms": register,
                    "track_traj_ids": False,
                },
                postproc=_rows,
                **common,
            )
        made.update_policy_weights_()
    except RuntimeError as error:  # TorchRL waits a minute for each of them
        if made is not None:
            made.shutdown()  # else they would keep their cores of a cluster that goes on
        raise not_started(cfg, error) from error
    return made


def _remote_env(threads: int, env: MakeEnv, worker: str) -> TrackEnv:
    torch.set_num_threads(threads)
    return own_env(env, worker)


class _Collector(RayCollector):
    """Raises the error of the other collectors where a worker is lost."""

    def iterator(self) -> Iterator[TensorDictBase]:
        with _losing():
            yield from super().iterator()

    def update_policy_weights_(self, *args: Any, **options: Any) -> None:
        with _losing():
            super().update_policy_weights_(*args, **options)


@contextmanager
def _losing() -> Iterator[None]:
    from ray.exceptions import RayError

    try:
        yield
    except RayError as error:
        raise RuntimeError(f"a worker was lost: {message_of(error)}") from error


def _rows(batch: TensorDictBase) -> TensorDictBase:
    """`[workers, envs, time]` as `[workers * envs, time]`."""
    return batch.flatten(0, 1)
