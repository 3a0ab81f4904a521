"""Sweeps on a Ray cluster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from trackmdp.app.sweep.job import run_job
from trackmdp.app.sweep.plan import Job
from trackmdp.app.sweep.schema import RayConfig
from trackmdp.errors import UserError
from trackmdp.training.signals import kept_sigterm

_STORE = 100 * 2**20
"""Bytes for the objects of a cluster started here; the runs hand over none."""


def launch_on_ray(cfg: RayConfig, jobs: Sequence[Job]) -> None:
    """Run `jobs` as tasks of a Ray cluster, which is left, or ended where it was started here.

    Raises:
        UserError: there is no such cluster.
    """
    import ray

    with kept_sigterm():  # which asks the sweep to stop
        _join(cfg, ray)
    try:
        # No retries by Ray: a run that was killed for lack of memory would be again; the sweep launches what is left
        # itself.
        task = ray.remote(num_cpus=cfg.cpus_per_run, num_gpus=cfg.gpus_per_run, max_retries=0)(run_job)
        left = [task.remote(job) for job in jobs]
        while left:  # what failed stands in the folders; a task whose worker died has left nothing there
            _, left = ray.wait(left, num_returns=1)
    finally:
        ray.shutdown()


def _join(cfg: RayConfig, ray: Any) -> None:
    quiet: dict[str, Any] = {"logging_level": "error", "include_dashboard": False}
    if cfg.address is None:
        ray.init(num_cpus=cfg.num_cpus, object_store_memory=_STORE, **quiet)
        return
    try:
        # Nothing about memory: Ray refuses `object_store_memory` and `num_cpus` for a cluster that runs already.
        ray.init(address=cfg.address, logging_level="error")
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"hydra.launcher.address={cfg.address}: expected a Ray cluster ({reason})") from error
