"""Sweeps through submitit: as jobs of a SLURM cluster, or as processes of this machine."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from trackmdp.app.sweep import process
from trackmdp.app.sweep.job import Launch, fail, run_job, stop_signal
from trackmdp.app.sweep.plan import Job
from trackmdp.app.sweep.schema import SubmititConfig, SubmititLocalConfig, SubmititSlurmConfig
from trackmdp.errors import FAILED, UserError
from trackmdp.training.signals import handled

SUBMISSIONS = ".submissions"
"""Folder, in that of the sweep, of what the scheduler is given and says."""

# Seconds between two looks for result files, and between two questions to the scheduler, which is shared by many
# users.
_POLL, _ASK = 0.5, 60.0


class Submission:
    """The submitted callable; where its job is preempted or out of time, it is submitted again and the run resumes."""

    def __call__(self, job: Job) -> None:
        """Run `job`."""
        from submitit.core.utils import UncompletedJobError

        try:
            run_job(job)
        except UncompletedJobError as error:  # raised by the scheduler's signal
            process.stop_all()
            fail(job, process.Outcome(FAILED, reason=f"stopped by the scheduler: {error}"))

    def checkpoint(self, job: Job) -> Any:
        """Let the run save, and return what is to be submitted next."""
        from submitit.helpers import DelayedSubmission

        process.stop_all()
        # submitit submits this once more; the run finds its folder, and resumes from its last checkpoint.
        return DelayedSubmission(self, job)


def launcher(cfg: SubmititConfig) -> Launch:
    """The launcher of `cfg`.

    Raises:
        UserError: there is no SLURM here.
    """
    if isinstance(cfg, SubmititLocalConfig):
        return partial(_local, cfg)
    assert isinstance(cfg, SubmititSlurmConfig)
    import submitit

    # Asked here: submitting would fail only after the sweep's folder has been made.
    if submitit.SlurmExecutor.affinity() < 0:
        raise UserError("hydra/launcher=submitit_slurm: expected a machine from which jobs can be submitted (no srun)")
    return partial(_slurm, cfg)


def _local(cfg: SubmititLocalConfig, jobs: Sequence[Job]) -> None:
    import submitit

    executor = submitit.LocalExecutor(_submissions(jobs))
    # 30 s before the time is out the job is told to save.
    executor.update_parameters(timeout_min=cfg.timeout_min, signal_delay_s=30)
    at_once = cfg.n_jobs or max(1, len(os.sched_getaffinity(0)) // cfg.cpus_per_task)
    running: list[Any] = []
    for job in jobs:
        # submitit's local executor starts whatever it is given at once; the limit is kept here.
        while sum(not each.done() for each in running) >= at_once:
            time.sleep(_POLL)
        if stop_signal(job.sweep):
            break
        # A process started here ignores Ctrl-C: the sweep receives it and stops them in order.
        with handled(signal.SIG_IGN, signal.SIGINT):
            running.append(executor.submit(Submission(), job))
    _wait(running)


def _slurm(cfg: SubmititSlurmConfig, jobs: Sequence[Job]) -> None:
    import submitit

    executor = submitit.AutoExecutor(_submissions(jobs), cluster="slurm", slurm_max_num_timeout=cfg.max_num_timeout)
    executor.update_parameters(
        name=f"trackmdp_{jobs[0].command}",
        timeout_min=cfg.timeout_min,
        cpus_per_task=cfg.cpus_per_task,
        mem_gb=cfg.mem_gb,
        gpus_per_node=cfg.gpus_per_node,
        slurm_array_parallelism=cfg.array_parallelism,
        slurm_signal_delay_s=cfg.signal_delay_s,
        slurm_partition=cfg.partition,
        slurm_account=cfg.account,
        slurm_setup=cfg.setup,
        slurm_additional_parameters=cfg.additional_parameters,
    )
    # One array job, of which the scheduler runs `array_parallelism` at once; one job each would flood its queue.
    _wait(executor.map_array(Submission(), list(jobs)))


def _submissions(jobs: Sequence[Job]) -> Path:
    return jobs[0].sweep / SUBMISSIONS


def _wait(submitted: Sequence[Any]) -> None:
    """Return once all jobs have ended; how each ended stands in its run's folder."""
    asked = time.monotonic()
    while left := [each for each in submitted if not each.done()]:
        if time.monotonic() - asked > _ASK:  # one that was killed leaves no file by which it would be known
            left[0].done(force_check=True)
            asked = time.monotonic()
        time.sleep(_POLL)
