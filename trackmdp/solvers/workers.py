"""Independent jobs, here, in processes of this machine, or on a Ray cluster: the same results in the same order."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from typing import Any, TypeVar

from trackmdp.errors import Preempted, UserError, require

Job = TypeVar("Job")
Result = TypeVar("Result")

_ATTEMPTS = 3
"""Times that a job is begun, if the worker that has it dies, before all is given up."""


def run_jobs(
    work: Callable[[Job], Result], jobs: Sequence[Job], *, workers: int = 1, cluster: str | None = None
) -> list[Result]:
    """`work` of every job, in their order, whoever did it; `work` and jobs are pickled where there are workers.

    Args:
        work: what is done; its own errors are raised here.
        jobs: what it is done to.
        workers: processes; one: this one.
        cluster: ``local``: a Ray cluster of so many workers on this machine; ``auto`` or host:port: one to join, which
            has as many as it has cores. None: no Ray.

    Raises:
        UserError: Ray is not installed or there is no such cluster, or the same job has killed its worker three times.
    """
    if cluster is not None:
        return _on_ray(work, jobs, workers, cluster)
    if workers == 1:
        return [work(job) for job in jobs]
    return _in_processes(work, jobs, workers)


def _in_processes(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> list[Result]:
    results: dict[int, Result] = {}
    for _ in range(_ATTEMPTS):
        left = [number for number in range(len(jobs)) if number not in results]
        # Spawned, not forked: a fork copies locks that another thread of this process may hold.
        spawning = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(workers, len(left)), spawning, _begin) as pool:
            futures = {number: pool.submit(_done, work, jobs[number]) for number in left}
            try:
                for number, future in futures.items():
                    # a worker died: what it and the others had not finished is done again
                    with suppress(BrokenProcessPool):
                        results[number] = future.result()
            except BaseException:
                for worker in list(pool._processes.values()):
                    worker.terminate()  # SIGTERM: who learns saves what there is, and is waited for
                pool.shutdown(cancel_futures=True)  # what was not begun is not begun any more
                raise
        if len(results) == len(jobs):
            return [results[number] for number in range(len(jobs))]
    raise UserError(f"partition.workers={workers}: workers died {_ATTEMPTS} times, expected enough memory for each")


_ended: list[Preempted] = []
"""In a worker: the signal that ended its last job."""


def _begin() -> None:
    # Ctrl-C goes to the whole group of processes; the parent hears it, and ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _done(work: Callable[[Job], Result], job: Job) -> Result:
    """`work` of `job` in a worker, to which the pool hands one job more than it can take back."""
    if _ended:
        raise _ended[0]
    try:
        return work(job)
    except Preempted as error:
        _ended.append(error)
        raise


def end_with_parent() -> None:
    """End this process with the one that spawned it, which cannot tell it to end when it is killed."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)  # not sys.exit, which would end this thread alone

    threading.Thread(target=wait, daemon=True).start()


def _on_ray(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int, cluster: str) -> list[Result]:
    require("ray", "ray", f"partition.cluster={cluster}")
    import ray

    where: dict[str, Any] = {"address": cluster}
    if cluster == "local":
        where = {"address": "local", "num_cpus": workers, "include_dashboard": False}
    begun = not ray.is_initialized()
    try:
        if begun:
            ray.init(logging_level=logging.ERROR, log_to_driver=False, **where)
    except (ConnectionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"partition.cluster={cluster}: expected a Ray cluster ({reason})") from error
    try:
        # Ray itself begins a task again whose worker or machine was lost.
        task: Any = ray.remote(num_cpus=1, max_retries=_ATTEMPTS - 1)(lambda job: work(job))
        return list(ray.get([task.remote(job) for job in jobs]))
    except ray.exceptions.RayTaskError as error:  # an error of the work itself, as it would be raised here
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise UserError(f"partition.cluster={cluster}: a worker was lost {_ATTEMPTS} times ({error})") from error
    finally:
        if begun:
            ray.shutdown()
