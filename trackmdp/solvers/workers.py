"""Independent jobs, here, in processes of this machine, or on a Ray cluster: the same results in the same order."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any, Protocol, TypeVar

from trackmdp.cluster import joining, ray_options
from trackmdp.errors import Preempted, UserError, require
from trackmdp.imports import safe_children
from trackmdp.signals import HEARD, handled

Piece = TypeVar("Piece")
Result = TypeVar("Result")

_ATTEMPTS = 3
"""Times that a job is begun, if the worker that has it dies, before all is given up."""
_RUN_ANEW = 78
"""Exit code of a worker that would begin workers of its own while it starts."""


class Crew(Protocol):
    """Runs jobs."""

    def __call__(self, work: Callable[[Piece], Result], jobs: Sequence[Piece]) -> list[Result]:
        """Some work done to each of the jobs, in their order; both are pickled where there are workers.

        Raises:
            UserError: the same job has killed its worker three times. Errors of the work are raised as they are.
        """


def in_turn(work: Callable[[Piece], Result], jobs: Sequence[Piece]) -> list[Result]:
    """A `Crew` of this process alone."""
    return [work(job) for job in jobs]


@dataclass(frozen=True)
class Made(Sequence[Piece]):
    """Jobs that are made when asked for, so that not all of them are there at once."""

    size: int
    make: Callable[[int], Piece]

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, number: Any) -> Any:
        if not 0 <= number < self.size:
            raise IndexError(number)
        return self.make(number)


@contextmanager
def crew(workers: int = 1, cluster: str | None = None) -> Iterator[Crew]:
    """Workers that stay from one call to the next; after an error or a signal the remaining ones are ended.

    Args:
        workers: processes; with 1 all is done in this process.
        cluster: ``local``: a Ray cluster of so many workers on this machine; ``auto`` or host:port: one to join, which
            has as many as it has cores. None: no Ray.

    Raises:
        UserError: Ray is not installed or there is no such cluster.
    """
    if cluster is not None:
        yield from _ray(workers, cluster)
    elif workers == 1:
        yield in_turn
    else:
        yield from _processes(workers)


def _processes(workers: int) -> Iterator[Crew]:
    pool = _pool(workers)

    def run(work: Callable[[Piece], Result], jobs: Sequence[Piece]) -> list[Result]:
        nonlocal pool
        results: dict[int, Result] = {}
        for _ in range(_ATTEMPTS):
            left = [number for number in range(len(jobs)) if number not in results]
            futures = dict[int, Future[Result]]()
            # a worker died: all unfinished jobs are run again
            with suppress(BrokenProcessPool):
                for number in left:
                    with starting():
                        futures[number] = pool.submit(_done, work, jobs[number])
            for number, future in futures.items():
                with suppress(BrokenProcessPool):
                    results[number] = future.result()
            if len(results) == len(jobs):
                return [results[number] for number in range(len(jobs))]
            dead = list((pool._processes or {}).values())
            pool.shutdown()
            if any(worker.exitcode == _RUN_ANEW for worker in dead):
                raise UserError(
                    f"partition.workers={workers}: each worker runs your script anew, expected its calls below "
                    'if __name__ == "__main__":'
                )
            pool = _pool(workers)
        raise UserError(
            f"partition.workers={workers}: workers died {_ATTEMPTS} times, expected enough memory for each"
        )

    try:
        yield run
    except BaseException:
        for worker in list((pool._processes or {}).values()):
            worker.terminate()  # SIGTERM: a learner saves its state, and is waited for
        raise
    finally:
        pool.shutdown(cancel_futures=True)  # no further job begins


_ended: list[Preempted] = []
"""In a worker: the signal that ended its last job."""


def _pool(workers: int) -> ProcessPoolExecutor:
    # A spawned process imports the main script; calls there that are not guarded come here again.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        os._exit(_RUN_ANEW)
    with starting():
        # Spawned, not forked: a fork copies locks that another thread of this process may hold.
        return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), end_with_parent)


@contextmanager
def starting(*more: signal.Signals) -> Iterator[None]:
    """Block SIGINT, SIGUSR1 and SIGHUP while workers start; they, and Python's tracker of semaphores, inherit the mask.

    This process notes the signals, ends the workers with SIGTERM, and raises the signals again at the end.

    Args:
        more: signals to be blocked as well.
    """
    later = {signal.SIGINT, signal.SIGUSR1, signal.SIGHUP, *more}
    heard: list[int] = []
    # A process that gets a signal while it still imports would write a traceback, so would a worker left half started.
    # The handler notes the signal all the same, since another thread may receive it.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, later)
    try:
        with handled(lambda number, _: heard.append(number), *HEARD), safe_children():
            resource_tracker.ensure_running()
            signal.pthread_sigmask(signal.SIG_BLOCK, later)  # its start has unblocked SIGINT
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number in heard:  # also where a worker has died of it already
            signal.raise_signal(number)


def _done(work: Callable[[Piece], Result], job: Piece) -> Result:
    """`work` of `job` in a worker, to which the pool hands one job more than it can take back."""
    if _ended:
        raise _ended[0]
    try:
        return work(job)
    except Preempted as error:
        _ended.append(error)
        raise


def end_with_parent(end: Callable[[], object] = lambda: os._exit(1)) -> None:
    """End this process with the one that spawned it, which cannot end it when it is killed.

    Args:
        end: ends the process, by default at once (sys.exit would end the waiting thread alone).
    """

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            # Returns when the parent's sentinel closes, which the system does however it ends.
            parent.join()
            end()

    threading.Thread(target=wait, daemon=True).start()


def _ray(workers: int, cluster: str) -> Iterator[Crew]:
    key = "partition.cluster"
    require("ray", "ray", f"{key}={cluster}")
    import ray

    begun = not ray.is_initialized()
    if begun:
        with joining(key, cluster):
            ray.init(log_to_driver=False, **ray_options(cluster, workers))

    def run(work: Callable[[Piece], Result], jobs: Sequence[Piece]) -> list[Result]:
        # Ray itself begins a task again if its worker or machine was lost.
        task: Any = ray.remote(num_cpus=1, max_retries=_ATTEMPTS - 1)(lambda job: work(job))
        tasks = [task.remote(job) for job in jobs]
        try:
            with _cancelled(ray, tasks):
                return list(ray.get(tasks))
        except (
            ray.exceptions.RayTaskError
        ) as error:  # an error of the work itself, as it would be raised here
            raise error.cause from None
        except ray.exceptions.RayError as error:
            raise UserError(
                f"{key}={cluster}: a worker was lost {_ATTEMPTS} times ({error})"
            ) from error

    try:
        yield run
    finally:
        if begun:
            ray.shutdown()


@contextmanager
def _cancelled(ray: Any, tasks: Sequence[Any]) -> Iterator[None]:
    """On an error or a signal, end the tasks that are under way and wait for them; begin no others."""
    before = {number: old for number in HEARD if callable(old := signal.getsignal(number))}
    heard: list[signal.Signals] = []

    def interrupt(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        heard.append(signal.Signals(number))
        raise KeyboardInterrupt  # Ray's waits swallow all others

    try:
        with handled(interrupt, *before):
            yield
    except BaseException:
        for task in tasks:
            ray.cancel(task)  # SIGINT: a learner saves its state
        ray.wait(tasks, num_returns=len(tasks))
        for number in heard[:1]:
            before[number](number, None)
        raise
