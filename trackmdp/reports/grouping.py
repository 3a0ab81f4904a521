"""Runs in groups: the world a run took place in, the method that learned, and the seed within them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from trackmdp.reports.results import FinishedRun

# The order of legends and tables, the same in every report; an algorithm that is not listed comes after these.
ORDER = ("a2c", "hindsight", "ppo", "dqn", "learned_kernel")
SHORT = {"kernel.support_size": "Z", "cost.sensor": "c", "grid.size": "N", "grid.t_max": "T_max"}
WORLD = ("grid.", "kernel.", "cost.")
TOLD = "kernel.homogeneous"
"""What a learner is told of the motion; it is the method's, not the world's."""
# What these hold changes how or how long a run is carried out, or which draw it is, not what is learned from.
NOT_METHOD = ("seed", "quiet", "device", "threads", "resume", "init_from")
NOT_METHOD_GROUPS = ("log.", "checkpoint.", "evaluation.", "optimal.")


@dataclass(frozen=True)
class Study:
    """Runs by world and method.

    Attributes:
        runs: all of them.
        worlds: labels, in order.
        methods: labels, in order.
        groups: (world, method) -> its runs, by seed; in the order of worlds, then of methods.
    """

    runs: Sequence[FinishedRun]
    worlds: Sequence[str]
    methods: Sequence[str]
    groups: Mapping[tuple[str, str], Sequence[FinishedRun]]

    def of(self, world: str, method: str) -> Sequence[FinishedRun]:
        """The runs of a method in a world, one per seed."""
        return self.groups.get((world, method), ())

    def in_world(self, world: str) -> list[FinishedRun]:
        """All runs in a world."""
        return [run for method in self.methods for run in self.of(world, method)]

    def known(self, world: str, *names: str) -> list[float]:
        """The figures of these names that the runs in a world have."""
        found = [run.figures[name] for run in self.in_world(world) for name in names]
        return [value for value in found if value is not None]

    def upper(self, world: str) -> float:
        """The best proved upper bound on the AIHTR in a world; nan where there is none, as on recorded tracks."""
        # A bound holds for the world, whichever run found it: the least of all is the tightest.
        return min(self.known(world, "optimal_upper", "bound_clocked"), default=math.nan)

    def lower(self, world: str) -> float | None:
        """The best AIHTR that the solver attained in a world."""
        return max(self.known(world, "optimal_lower"), default=None)

    def best(self, world: str) -> float:
        """The AIHTR of the best policy known in a world, the solver's or a run's; nan where no bound is known."""
        if math.isnan(self.upper(world)):
            return math.nan
        return max(self.known(world, "optimal_lower", "qmdp_aihtr", "aihtr"), default=math.nan)

    def regret(self, run: FinishedRun, world: str, aihtr: float | None = None) -> float:
        """Distance per step to the best proved upper bound, of the run's policy or of one that earns `aihtr`."""
        earned = run.figure("aihtr") if aihtr is None else aihtr
        # Per step, so that worlds whose targets stay for a different time can be averaged.
        return (self.upper(world) - earned) / run.figure("expected_length")

    def bracket(self, world: str) -> float:
        """Per step, how far the regrets in a world may be too large: from the best policy known to the bound."""
        run = self.in_world(world)[0]
        return self.regret(run, world, self.best(world))

    def regrets(self, world: str, method: str) -> list[float]:
        """Regret per step of each run; none where no bound is known."""
        known = not math.isnan(self.upper(world))
        return [self.regret(run, world) for run in self.of(world, method)] if known else []


def study(runs: Sequence[FinishedRun]) -> Study:
    """Group `runs`; labels name only what differs between them."""
    varied = _varied(runs)
    labels = {run.name: (_world_label(run, varied), _method_label(run, varied)) for run in runs}
    # Reversed, so that the first of the runs with one label decides: later entries of a dict overwrite.
    order = {labels[run.name]: _order(run, varied) for run in reversed(runs)}
    groups: dict[tuple[str, str], list[FinishedRun]] = {}
    for run in sorted(runs, key=lambda run: (order[labels[run.name]], run.seed, run.name)):
        groups.setdefault(labels[run.name], []).append(run)
    worlds = dict.fromkeys(world for world, _ in sorted(groups, key=lambda label: order[label][0]))
    methods = dict.fromkeys(method for _, method in sorted(groups, key=lambda label: order[label][1]))
    return Study(runs, list(worlds), list(methods), groups)


def world_key(run: FinishedRun) -> str:
    """The same for runs in the same world."""
    return json.dumps({key: value for key, value in run.settings.items() if _of_world(key)}, sort_keys=True)


def _of_world(key: str) -> bool:
    return key.startswith(WORLD) and key != TOLD


def _varied(runs: Sequence[FinishedRun]) -> list[str]:
    """Options that go into labels: they differ within an algorithm (or a world) and no earlier one determines them."""
    values: dict[str, dict[str, set[str]]] = {}
    for run in runs:
        for key, value in run.settings.items():
            # Per algorithm: that PPO and A2C have other learning rates does not tell two runs of PPO apart.
            owner = "" if _of_world(key) else run.algo
            values.setdefault(key, {}).setdefault(owner, set()).add(json.dumps(value))
    found = [key for key, owned in values.items() if any(len(each) > 1 for each in owned.values())]
    found = [key for key in found if key not in NOT_METHOD and not key.startswith(NOT_METHOD_GROUPS)]
    kept: list[str] = []
    # Options with a short name first, since of two that go together the one found first is kept.
    for key in sorted(found, key=lambda key: (not _of_world(key), key not in SHORT, key)):
        # A sweep over the price may set another option along with it; a label that names both says one thing twice.
        if key != "algo.name" and not any(_follows(runs, key, other) for other in kept):
            kept.append(key)
    return kept


def _follows(runs: Iterable[FinishedRun], key: str, other: str) -> bool:
    """Whether `key` is determined by `other` on these runs; both belong to the world, or both to the method."""
    if _of_world(key) != _of_world(other):
        return False
    seen: dict[str, str] = {}
    pairs = [(run.algo + json.dumps(run.settings.get(other)), json.dumps(run.settings.get(key))) for run in runs]
    # Whether `other` -> `key` is a function on these runs.
    return all(seen.setdefault(mine, its) == its for mine, its in pairs)


def _world_label(run: FinishedRun, varied: Sequence[str]) -> str:
    # Z and c name the paper's worlds, also where a sweep has one value of them.
    always = ["kernel.support_size", "cost.sensor"]
    keys = [*always, *(key for key in varied if _of_world(key) and key not in always)]
    named = [f"{_short(key)}={_text(run.settings[key])}" for key in keys if run.settings.get(key) is not None]
    kernel = run.settings.get("kernel.name")
    return ", ".join(named if kernel == "random_support" else [str(kernel), *named])


def _method_label(run: FinishedRun, varied: Sequence[str]) -> str:
    keys = [key for key in varied if not _of_world(key) and key in run.settings]
    return ", ".join([run.algo, *(f"{_short(key)}={_text(run.settings[key])}" for key in keys)])


def _order(run: FinishedRun, varied: Sequence[str]) -> tuple[Any, Any]:
    world = [_sortable(run.settings.get(key)) for key in [*SHORT, *varied] if key in SHORT or _of_world(key)]
    place = ORDER.index(run.algo) if run.algo in ORDER else len(ORDER)
    method = [_sortable(run.settings.get(key)) for key in varied if not _of_world(key)]
    return world, (place, run.algo, method)


def _sortable(value: Any) -> tuple[int, float, str]:
    # Numbers by size, 0.16 before 0.2; everything else after them by its text. The pair keeps the two from being
    # compared.
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return 0, float(value), ""
    return 1, 0.0, json.dumps(value)


def _short(key: str) -> str:
    return SHORT.get(key) or key.removeprefix("algo.").removeprefix("kernel.").removeprefix("grid.")


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "x".join(map(str, value)) if len(value) == 2 else f"a list of {len(value)}"
    return f"{value:g}" if isinstance(value, float) else str(value)
