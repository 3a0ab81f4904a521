"""Target tracking with controlled sensing: learn it, solve it, study it (Track-MDP).

    import trackmdp as tm

    world = tm.make_world("random_support", size=10, support_size=5, cost=0.16, t_max=1)
    run = tm.train(world, "hindsight", seed=0)               # policy, evaluation, metrics; no folder needed
    best = tm.solve(world)                                   # policy, lower, upper, certified
    tm.evaluate(world, run.policy)                           # exact figures
    tm.frontier(world).at(sensors=2)                         # the most accurate policies with two sensors per step
    episodes = tm.simulate(world, run.policy, 100, seed=0)   # for the log, the page and the picture
    env = tm.TrackEnv(world, 64)                             # TorchRL; any batch size
    tracker = run.policy.tracker(cell=42)                    # at work: tracker.sensors(), tracker.report(cell or None)

Every name below is imported from its module when it is first used: ``import trackmdp`` loads neither torch nor scipy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_HOMES = {
    "Episodes": "trackmdp.episodes.batch",
    "Evaluation": "trackmdp.solvers.evaluation",
    "Group": "trackmdp.world.group",
    "GroupTracker": "trackmdp.solvers.several.group_tracker",
    "ObservationVector": "trackmdp.environment.observation",
    "Policy": "trackmdp.policies.policy",
    "Recorded": "trackmdp.recordings.tracks",
    "Run": "trackmdp.training.run",
    "RunError": "trackmdp.errors",
    "Solution": "trackmdp.solvers.solution",
    "TrackEnv": "trackmdp.environment.env",
    "Tracker": "trackmdp.policies.tracker",
    "Tradeoff": "trackmdp.solvers.tradeoff",
    "UserError": "trackmdp.errors",
    "World": "trackmdp.world.model",
    "compare": "trackmdp.training.compare",
    "evaluate": "trackmdp.solvers.evaluate",
    "export": "trackmdp.policies.export",
    "frontier": "trackmdp.solvers.frontier",
    "load_run": "trackmdp.training.run",
    "load_tracks": "trackmdp.world.make",
    "make_world": "trackmdp.world.make",
    "simulate": "trackmdp.episodes.simulate",
    "solve": "trackmdp.solvers.solve",
    "train": "trackmdp.training.train",
}
"""Name -> the module it is defined in."""

__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same once more, for type checkers and editors; `X as X` marks a public name
    from trackmdp.environment.env import TrackEnv as TrackEnv
    from trackmdp.environment.observation import ObservationVector as ObservationVector
    from trackmdp.episodes.batch import Episodes as Episodes
    from trackmdp.episodes.simulate import simulate as simulate
    from trackmdp.errors import RunError as RunError
    from trackmdp.errors import UserError as UserError
    from trackmdp.policies.export import export as export
    from trackmdp.policies.policy import Policy as Policy
    from trackmdp.policies.tracker import Tracker as Tracker
    from trackmdp.recordings.tracks import Recorded as Recorded
    from trackmdp.solvers.evaluate import evaluate as evaluate
    from trackmdp.solvers.evaluation import Evaluation as Evaluation
    from trackmdp.solvers.frontier import frontier as frontier
    from trackmdp.solvers.several.group_tracker import GroupTracker as GroupTracker
    from trackmdp.solvers.solution import Solution as Solution
    from trackmdp.solvers.solve import solve as solve
    from trackmdp.solvers.tradeoff import Tradeoff as Tradeoff
    from trackmdp.training.compare import compare as compare
    from trackmdp.training.run import Run as Run
    from trackmdp.training.run import load_run as load_run
    from trackmdp.training.train import train as train
    from trackmdp.world.group import Group as Group
    from trackmdp.world.make import load_tracks as load_tracks
    from trackmdp.world.make import make_world as make_world
    from trackmdp.world.model import World as World


import trackmdp.gym  # noqa: E402, F401 (registers the environment once Gymnasium is imported)


def __getattr__(name: str) -> Any:
    """Import a public name (PEP 562); Python calls this only for names that are not there yet."""
    if name == "HiddenWorld":
        raise AttributeError("HiddenWorld: renamed, expected World with modes=...")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # Kept among the module's globals: the next access is an ordinary look-up that does not come here.
    found = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return found


def __dir__() -> list[str]:
    # Completion offers the public names, also those not used yet, and no module or helper of this file.
    return [*__all__, *(name for name in globals() if name.startswith("__"))]
