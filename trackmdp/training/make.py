"""From config to the parts of a run, each made by what its choice names."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector

from trackmdp.algos.common import Algorithm
from trackmdp.config import CsvConfig, TrainConfig
from trackmdp.config.registry import maker
from trackmdp.training.callbacks import Callback
from trackmdp.world.model import Task
from trackmdp.world.tracks import Problem


def make_algorithm(cfg: TrainConfig, task: Task, device: torch.device) -> Algorithm:
    """The learner; it is given the task, never the motion."""
    # Rounded up: 100,001 frames in batches of 10,000 are 11 iterations, the last one whole as well.
    batches = -(-cfg.collector.total_frames // cfg.collector.frames_per_batch)
    made: Algorithm = maker(cfg.algo)(task.task, cfg.algo, iterations=batches, seed=cfg.seed, device=device)
    return made


def make_collector(
    cfg: TrainConfig, problem: Problem, policy: TensorDictModuleBase, device: torch.device, *, done: int = 0
) -> BaseCollector:
    """The source of the frames that are left after the first `done`."""
    more = {"seed": cfg.seed, "device": device, "done": done}
    made: BaseCollector = maker(cfg.collector)(problem, policy, cfg.collector, **more)
    return made


def make_loggers(cfg: TrainConfig, folder: Path) -> list[Callback]:
    """What the run writes of itself while it learns."""
    # metrics.csv is written whatever the log is: reports and `Run.metrics` read it. `csv` stays first, with the options
    # of its own where it is chosen.
    chosen = {"csv": CsvConfig(every=1)} | cfg.log
    # Each is imported by the name in its schema, since the packages it may need (mcap) are not to load without it.
    return [maker(node)(node, folder) for node in chosen.values()]
