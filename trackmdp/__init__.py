"""Target tracking with controlled sensing: learn it, solve it, study it (Track-MDP).

    import trackmdp as tm

    world = tm.make_world("random_support", size=10, support_size=5, cost=0.16, t_max=1)
    run = tm.train(world, "hindsight", seed=0)               # policy, evaluation, metrics; no folder needed
    best = tm.solve(world)                                   # policy, lower, upper, certified
    tm.evaluate(world, run.policy)                           # exact figures
    episodes = tm.simulate(world, run.policy, 100, seed=0)   # what the log, the page and the picture are made of
    env = tm.TrackEnv(world, 64)                             # TorchRL; any batch size

Every name below is imported from its module when it is first used: ``import trackmdp`` loads neither torch nor scipy.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_HOMES = {
    "Episodes": "trackmdp.episodes.batch",
    "Evaluation": "trackmdp.solvers.evaluation",
    "HiddenWorld": "trackmdp.world.modes",
    "ObservationVector": "trackmdp.world.observation",
    "Policy": "trackmdp.policies.policy",
    "Recorded": "trackmdp.world.tracks",
    "Run": "trackmdp.training.run",
    "Solution": "trackmdp.solvers.solution",
    "TrackEnv": "trackmdp.world.env",
    "World": "trackmdp.world.model",
    "evaluate": "trackmdp.solvers.evaluate",
    "load_run": "trackmdp.training.run",
    "load_tracks": "trackmdp.world.make",
    "make_world": "trackmdp.world.make",
    "simulate": "trackmdp.episodes.simulate",
    "solve": "trackmdp.solvers.solve",
    "train": "trackmdp.training.train",
}
"""Name -> the module it is defined in."""

__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same once more, for type checkers and editors; `X as X` tells them that it is public
    from trackmdp.episodes.batch import Episodes as Episodes
    from trackmdp.episodes.simulate import simulate as simulate
    from trackmdp.policies.policy import Policy as Policy
    from trackmdp.solvers.evaluate import evaluate as evaluate
    from trackmdp.solvers.evaluation import Evaluation as Evaluation
    from trackmdp.solvers.solution import Solution as Solution
    from trackmdp.solvers.solve import solve as solve
    from trackmdp.training.run import Run as Run
    from trackmdp.training.run import load_run as load_run
    from trackmdp.training.train import train as train
    from trackmdp.world.env import TrackEnv as TrackEnv
    from trackmdp.world.make import load_tracks as load_tracks
    from trackmdp.world.make import make_world as make_world
    from trackmdp.world.model import World as World
    from trackmdp.world.modes import HiddenWorld as HiddenWorld
    from trackmdp.world.observation import ObservationVector as ObservationVector
    from trackmdp.world.tracks import Recorded as Recorded


if "gymnasium" in sys.modules:
    import trackmdp.gym  # noqa: F401


def __getattr__(name: str) -> Any:
    """Import a public name (PEP 562); Python calls this only for names that are not there yet."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # Kept among the module's globals: the next access is an ordinary look-up that does not come here.
    found = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return found


def __dir__() -> list[str]:
    # Without this, completion would offer only the names that have been used already.
    return sorted({*globals(), *__all__})
