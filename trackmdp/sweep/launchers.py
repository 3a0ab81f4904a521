"""Where the jobs of a sweep are run: one after the other here, or several at once here or elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from trackmdp.config.sweeps import Basic, Launcher
from trackmdp.sweep.job import run_job
from trackmdp.sweep.plan import Job

__all__ = ["Launch", "make_launcher"]

Launch = Callable[[Sequence[Job]], None]
"""Runs jobs, and comes back once none is running any more."""


def make_launcher(cfg: Launcher) -> Launch:
    """The launcher that `hydra/launcher=NAME` chose.

    Raises:
        UserError: what it needs is not installed.
    """
    assert isinstance(cfg, Basic)
    return _basic


def _basic(jobs: Sequence[Job]) -> None:
    for job in jobs:
        run_job(job)
