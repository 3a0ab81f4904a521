"""Where the jobs of a sweep run: one after the other on this machine, or several at once, here or on a cluster.

A launcher reports nothing: the result of each run is in its folder, for runs in any process.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from trackmdp.app.sweep import process
from trackmdp.app.sweep.plan import Job
from trackmdp.app.sweep.process import fail, run_job, stop_signal
from trackmdp.cluster import joining, ray_options
from trackmdp.config import TrainConfig, sweeping
from trackmdp.solvers.workers import starting

# Each names the threads of one library (OpenMP, OpenBLAS, MKL), which by default take all cores, in every run at once.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_STORE = 100 * 2**20
"""Bytes for the objects of a Ray cluster started here; the runs hand over none."""

SUBMISSIONS = ".submissions"
"""Folder, in the sweep's, of the scheduler's inputs and outputs."""

# Seconds between two looks for result files, and between two questions to the scheduler, which is shared by many
# users.
_POLL, _ASK = 0.5, 60.0


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


def run_basic(cfg: sweeping.BasicConfig, jobs: Sequence[Job]) -> None:  # noqa: ARG001
    """One after the other."""
    for job in jobs:
        run_job(job)


def run_joblib(cfg: sweeping.JoblibConfig, jobs: Sequence[Job]) -> None:
    """In threads: each only waits for the process of its run."""
    from joblib import Parallel, delayed

    # Cores this process may use, which in a container or a cluster's job are fewer than the machine has.
    at_once = cfg.n_jobs or len(os.sched_getaffinity(0))
    # Threads: joblib's own processes (loky) give up the whole sweep when one of them is killed. `batch_size=1`: a
    # thread that took several runs at once would hold them back from threads that are idle.
    Parallel(n_jobs=at_once, backend="threading", batch_size=1)(
        delayed(run_job)(job) for job in jobs
    )


def run_on_ray(cfg: sweeping.RayConfig, jobs: Sequence[Job]) -> None:
    """Run `jobs` as tasks of a Ray cluster, which is left, or ended where it was started here.

    Raises:
        UserError: there is no such cluster.
    """
    import ray

    with joining("hydra.launcher.address", cfg.address):
        ray.init(**ray_options(cfg.address, cfg.num_cpus, _STORE))
    try:
        # No retries by Ray: a run that was killed for lack of memory would be again; the sweep launches the rest
        # itself.
        task = ray.remote(num_cpus=cfg.cpus_per_run, num_gpus=cfg.gpus_per_run, max_retries=0)(
            run_job
        )
        left = [task.remote(job) for job in jobs]
        while left:  # failures are in the folders; a task with a dead worker has left nothing there
            _, left = ray.wait(left, num_returns=1)
    finally:
        ray.shutdown()


class Submission:
    """The submitted callable; where its job is preempted or out of time, it is submitted again and the run resumes."""

    def __call__(self, job: Job) -> None:
        """Run `job`."""
        from submitit.core.utils import UncompletedJobError

        try:
            run_job(job)
        except UncompletedJobError as error:  # raised by the scheduler's signal
            process.stop_all()
            fail(job, f"stopped by the scheduler: {error}")

    def checkpoint(self, job: Job) -> Any:
        """Let the run save, and return the next submission."""
        from submitit.helpers import DelayedSubmission

        process.stop_all()
        # submitit submits this once more; the run finds its folder, and resumes from its last checkpoint.
        return DelayedSubmission(self, job)


def run_here(cfg: sweeping.SubmititLocalConfig, jobs: Sequence[Job]) -> None:
    """As processes of this machine."""
    import submitit

    executor = submitit.LocalExecutor(jobs[0].sweep / SUBMISSIONS)
    # 30 s before the time is out the job gets a signal to save.
    executor.update_parameters(timeout_min=cfg.timeout_min, signal_delay_s=30)
    at_once = cfg.n_jobs or max(1, len(os.sched_getaffinity(0)) // cfg.cpus_per_task)
    running: list[Any] = []
    for job in jobs:
        # submitit's local executor starts all jobs at once; the limit is kept here.
        while sum(not each.done() for each in running) >= at_once:
            time.sleep(_POLL)
        if stop_signal(job.sweep):
            break
        # A process started here does not hear Ctrl-C: the sweep receives it and stops them in order.
        with starting():
            running.append(executor.submit(Submission(), job))
    _wait(running)


def run_on_slurm(cfg: sweeping.SubmititSlurmConfig, jobs: Sequence[Job]) -> None:
    """As one array job."""
    import submitit

    folder = jobs[0].sweep / SUBMISSIONS
    executor = submitit.AutoExecutor(
        folder, cluster="slurm", slurm_max_num_timeout=cfg.max_num_timeout
    )
    # submitit has a word of its own for what every cluster has.
    shared = ("timeout_min", "cpus_per_task", "mem_gb", "gpus_per_node")
    asked = {name if name in shared else f"slurm_{name}": each for name, each in vars(cfg).items()}
    del asked["slurm_max_num_timeout"]
    executor.update_parameters(name=f"trackmdp_{jobs[0].command}", **asked)
    # One array job, of which the scheduler runs `array_parallelism` at once; one job each would flood its queue.
    _wait(executor.map_array(Submission(), list(jobs)))


def _wait(submitted: Sequence[Any]) -> None:
    """Return once all jobs have ended; how each ended stands in its run's folder."""
    asked = time.monotonic()
    while left := [each for each in submitted if not each.done()]:
        if (
            time.monotonic() - asked > _ASK
        ):  # one that was killed leaves no file by which it would be known
            left[0].done(force_check=True)
            asked = time.monotonic()
        time.sleep(_POLL)
