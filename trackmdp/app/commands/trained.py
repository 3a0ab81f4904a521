"""The policy of a run, loaded from one of its checkpoints."""

from __future__ import annotations

from pathlib import Path

import torch

from trackmdp.algos.common import make_algorithm
from trackmdp.config import load_run_config
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy, actor_table
from trackmdp.training import checkpoint
from trackmdp.training.inputs import check_inputs
from trackmdp.training.run import load_run
from trackmdp.training.state import load_learned
from trackmdp.world.make import make_problem
from trackmdp.world.tracks import Problem


def trained(run: str, device: torch.device, *, best: bool = False) -> tuple[Problem, Policy, str]:
    """Where a run learned, the policy of its newest checkpoint, or of the best one, and what to call it.

    Of a run by blocks it is the run's own.

    Raises:
        UserError: that is no run, or the checkpoint is missing, damaged or another run's.
    """
    cfg, folder = load_run_config(run), Path(run)
    world = make_problem(cfg)
    if cfg.partition.block is not None:
        if best:
            raise UserError(
                f"checkpoint=best: expected newest for run={run}, whose blocks have checkpoints of their own"
            )
        check_inputs(world, folder)
        return world, load_run(folder).policy, f"{cfg.algo.name}, by blocks"
    algorithm = make_algorithm(cfg, world, device)
    file = folder / "checkpoints" / checkpoint.BEST if best else checkpoint.newest(folder)
    load_learned(algorithm, cfg, file, device)
    check_inputs(world, folder)
    policy = actor_table(world.task, algorithm.actor, device=device)
    return world, policy, f"{cfg.algo.name}, {file.name}"
