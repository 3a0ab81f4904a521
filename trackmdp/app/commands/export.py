"""`export`: a learned policy as a file for other programs."""

from __future__ import annotations

from pathlib import Path

import torch

from trackmdp.config import ExportConfig
from trackmdp.policies.export import export
from trackmdp.policies.geojson import checked_place
from trackmdp.policies.saved import sets_name, write_sets
from trackmdp.solvers.value import value_of
from trackmdp.training.display import make_console
from trackmdp.training.run import trained
from trackmdp.world.group import one_target


def run(cfg: ExportConfig, folder: Path) -> None:
    """Write the policy of a run to `folder`; see `trackmdp.policies.export`.

    Raises:
        UserError: there is no such run, or a package that `cfg.format` needs is missing.
    """
    best = cfg.checkpoint == "best"
    world, policy, subject = trained(cfg.run, torch.device("cpu"), best=best)
    world = one_target(world, f"run={cfg.run}")
    if cfg.format == "sets":
        file = folder / sets_name(policy)
        write_sets(folder, policy)
    else:
        file = folder / f"policy.{cfg.format}"
        value = None
        if cfg.format == "geojson":
            checked_place(policy)  # before the values, which take long on a large grid
            value = value_of(world, policy).value
        export(policy, file, value=value, label=subject)
    make_console(cfg.quiet).print(f"{subject} -> {file}")
