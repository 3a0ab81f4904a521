"""Where the jobs of a sweep run: one after the other on this machine, or several at once, here or on a cluster.

A launcher reports nothing: what became of each run stands in its folder, in whatever process it ran.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

from trackmdp.app.sweep.job import Launch, run_job
from trackmdp.app.sweep.plan import Job
from trackmdp.app.sweep.process import context_for
from trackmdp.app.sweep.schema import BasicConfig, JoblibConfig, LauncherConfig, RayConfig, SubmititConfig
from trackmdp.config import TrainConfig
from trackmdp.errors import UserError, require
from trackmdp.training.signals import kept_sigterm

# Each names the threads of one library (OpenMP, OpenBLAS, MKL), which by default take all cores, in every run at once.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_STORE = 100 * 2**20
"""Bytes for the objects of a Ray cluster started here; the runs hand over none."""


def make_launcher(cfg: LauncherConfig) -> Launch:
    """The launcher that `hydra/launcher=NAME` chose.

    Raises:
        UserError: what it needs is not installed.
    """
    if isinstance(cfg, BasicConfig):
        return _basic
    launch = _parallel(cfg)
    return lambda jobs: launch([replace(job, concurrent=True) for job in jobs])


def _parallel(cfg: LauncherConfig) -> Launch:
    option = f"hydra/launcher={cfg.name}"
    if isinstance(cfg, JoblibConfig):
        require("joblib", "sweep", option)
        return partial(_joblib, cfg)
    if isinstance(cfg, SubmititConfig):
        require("submitit", "slurm", option)
        from trackmdp.app.sweep import cluster

        return cluster.launcher(cfg)
    assert isinstance(cfg, RayConfig)
    require("ray", "ray", option)
    return partial(_on_ray, cfg)


@contextmanager
def threads_of(jobs: Sequence[Job]) -> Iterator[None]:
    """Processes started inside have as many threads as the runs ask for, where nothing else was asked for."""
    most = max((job.cfg.threads for job in jobs if isinstance(job.cfg, TrainConfig)), default=1)
    # Set by the user or by the cluster: theirs counts.
    unset = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(unset, str(most)))
    try:
        yield
    finally:
        for name in unset:
            os.environ.pop(name, None)


def _basic(jobs: Sequence[Job]) -> None:
    for job in jobs:
        run_job(job)


def _joblib(cfg: JoblibConfig, jobs: Sequence[Job]) -> None:
    """In threads: each only waits for the process of its run."""
    from joblib import Parallel, delayed

    # In the main thread, before joblib's threads start runs: only there can the fork server be made to ignore signals.
    context_for(jobs[0].command)
    # Cores this process may use, which in a container or a cluster's job are fewer than the machine has.
    at_once = cfg.n_jobs or len(os.sched_getaffinity(0))
    # Threads: joblib's own processes (loky) give up the whole sweep when one of them is killed. `batch_size=1`: a
    # thread that took several runs at once would hold them back from threads that are idle.
    Parallel(n_jobs=at_once, backend="threading", batch_size=1)(delayed(run_job)(job) for job in jobs)


def _on_ray(cfg: RayConfig, jobs: Sequence[Job]) -> None:
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
