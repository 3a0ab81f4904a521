"""Runs in groups: the world of a run, the method that learned, and the seeds within them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, product
from typing import Any

from trackmdp.reports.results import CONTENT, FinishedRun

# Order of legends and tables; other algorithms follow.
ORDER = ("a2c", "hindsight", "ppo", "dqn", "model_based")
SHORT = {
    "kernel.support_size": "Z",
    "cost.sensor": "c",
    "grid.size": "N",
    "grid.t_max": "T_max",
    "targets.count": "K",
}
OPEN = 5e-5
"""Regret per step that no figure of four digits shows: a narrower bracket is an optimum."""
_WORLD = ("grid.", "kernel.", "cost.", "sensor.", "targets.count")
# Options of no effect on the learned policy, or of its draw.
_IGNORED = (
    *("seed", "quiet", "device", "threads", "resume"),
    *("log.", "checkpoint.", "evaluation.", "optimal."),
)

_EARNED = ("aihtr", "held_out_aihtr")
"""Figures by which a policy is better than another one; on recordings others have the second."""

Options = Mapping[str, Any]


@dataclass(frozen=True)
class Study:
    """Runs by world and method.

    Attributes:
        worlds: labels, in order.
        methods: labels, in order.
        groups: (world, method) -> runs by seed; in the order of worlds, then of methods.
    """

    worlds: Sequence[str]
    methods: Sequence[str]
    groups: Mapping[tuple[str, str], Sequence[FinishedRun]]

    def of(self, world: str = "", method: str = "") -> list[FinishedRun]:
        """All runs, or those in a world, of a method, or of both, which are ordered by seed."""
        pairs = product([world] if world else self.worlds, [method] if method else self.methods)
        return [run for pair in pairs for run in self.groups.get(pair, ())]

    def references(self) -> list[str]:
        """Names of the policies and bounds that runs are compared with."""
        return [*dict.fromkeys(name for run in self.of() for name in run.references)]

    def title(self, reference: str) -> str:
        """The name of a policy or bound as it is shown: `best known` is the optimum where all brackets are closed."""
        closed = all(self.bracket(world) < OPEN for world in self.worlds)
        return "optimum" if closed and reference == "best known" else reference

    def value(self, world: str, run: FinishedRun, key: str) -> float:
        """A figure of a run, or its `regret` per step to the best upper bound; nan where unknown."""
        return self.regret(run, world) if key == "regret" else run.figure(key)

    def values(self, world: str, method: str, key: str) -> list[float]:
        """The known values of a figure of all runs of a method in a world."""
        return _known(self.value(world, run, key) for run in self.of(world, method))

    def regrets(self, method: str) -> list[list[float]]:
        """Regret per step of the runs of a method, by world; without worlds that have no bound."""
        return [*filter(None, (self.values(world, method, "regret") for world in self.worlds))]

    def reference(self, world: str, name: str, key: str) -> float:
        """The same of another policy or bound in a world, of the largest AIHTR where runs differ."""
        runs = self.of(world)
        if key == "regret":
            return self.regret(runs[0], world, self.reference(world, name, "aihtr"))
        found = [run.references.get(name, {}) for run in runs]
        best = max(found, key=lambda each: max(_known(map(each.get, _EARNED)), default=-math.inf))
        return math.nan if (value := best.get(key)) is None else value

    def upper(self, world: str) -> float:
        """Least proved upper bound on the AIHTR in a world; nan on recordings."""
        proved = [run.figure("optimal_upper") for run in self.of(world)]
        clocked = self.reference(world, "clocked bound", "aihtr")
        return min(_known([*proved, clocked]), default=math.nan)

    def best(self, world: str) -> float:
        """AIHTR of the best policy known in a world: of a run, of the solver, or Q_MDP."""
        keys = ("aihtr", "optimal_lower")
        found = [run.figure(key) for run in self.of(world) for key in keys]
        return max(_known([*found, self.reference(world, "Q_MDP", "aihtr")]))

    def regret(self, run: FinishedRun, world: str, aihtr: float | None = None) -> float:
        """Distance per step from the best upper bound to the AIHTR of the run, or to `aihtr`; nan without a bound."""
        earned = run.figure("aihtr") if aihtr is None else aihtr
        # Per step: worlds with different lengths of stay can be averaged.
        return (self.upper(world) - earned) / run.figure("expected_length")

    def ends(self, world: str) -> tuple[float | None, float | None]:
        """Best AIHTR known and least upper bound in a world whose optimum is not certified; else None."""
        shown = self.best(world), self.upper(world)
        return shown if self.bracket(world) >= OPEN else (None, None)

    def bracket(self, world: str) -> float:
        """Largest error per step of the regrets in a world: from the best policy known to the bound."""
        return self.regret(self.of(world)[0], world, self.best(world))


def _known(values: Iterable[float | None]) -> list[float]:
    return [value for value in values if value is not None and math.isfinite(value)]


def changed(runs: Sequence[FinishedRun]) -> dict[str, str]:
    """Name of a run -> that of an earlier one whose options name the same files, of another content."""
    first: dict[str, FinishedRun] = {}
    found = {}
    for run in runs:
        world, _ = _parted(run.settings)
        key = json.dumps({**world, CONTENT: ""}, sort_keys=True)
        known = first.setdefault(key, run)
        if known.settings.get(CONTENT) != run.settings.get(CONTENT):
            found[run.name] = known.name
    return found


def study(runs: Sequence[FinishedRun]) -> Study:
    """Group runs; a label names the options that differ between them."""
    telling = _telling(runs)
    parts = {run.name: _parted(run.settings, telling) for run in runs}
    of_world, of_method = ({name: each[k] for name, each in parts.items()} for k in (0, 1))
    worlds = _labels(of_world, "kernel.name", named=("kernel.support_size", "cost.sensor"))
    methods = _labels(of_method, "algo.name")
    groups: dict[tuple[str, str], list[FinishedRun]] = {
        pair: [] for pair in product(worlds.values(), methods.values())
    }
    for run in sorted(runs, key=lambda run: (run.seed, run.name)):
        groups[worlds[run.name], methods[run.name]].append(run)
    # Not every method ran in every world.
    filled = {labels: group for labels, group in groups.items() if group}
    return Study([*dict.fromkeys(worlds.values())], [*dict.fromkeys(methods.values())], filled)


def _telling(runs: Sequence[FinishedRun]) -> set[str]:
    """Options that no method is named by, but in which runs of one seed differ: else that seed would count twice."""
    alike: dict[str, list[Options]] = {}
    for run in runs:
        key = json.dumps([*_parted(run.settings), run.seed], sort_keys=True)
        alike.setdefault(key, []).append(run.settings)
    return {
        key
        for group in alike.values()
        for key in {*chain(*group)} - {"quiet", "resume"}
        if any(each.get(key) != group[0].get(key) for each in group)
    }


def _parted(settings: Options, telling: Collection[str] = ()) -> tuple[Options, Options]:
    """Options of the world and of the method, those that set neither, nor are `telling`, left out."""
    # The options with a short name first: of options that vary together the first one is named.
    world = {key: settings[key] for key in SHORT if key in settings}
    method = {}
    for key, value in settings.items():
        if key.startswith(_WORLD):
            world[key] = value
        elif key == "init_from" and key not in telling:  # each seed may have a source of its own
            method[key] = value and "a run"
        elif key in telling or not key.startswith(_IGNORED):
            method[key] = value
    return world, method


def _labels(found: Mapping[str, Options], head: str, named: Sequence[str] = ()) -> dict[str, str]:
    """Name of each run -> label of its world or method, in the order of the labels.

    Options that differ, yet read alike, as two lists of prices do, are told apart by a number after the label.

    Args:
        found: name of each run -> options of its world or method.
        head: option with the name of the kernel or the algorithm, which begins a label.
        named: options that every label names, whether they differ or not.
    """
    keys = [*dict.fromkeys((*named, *_varied([*found.values()], head)))]

    def order(run: str) -> Any:
        name = found[run][head]
        place = ORDER.index(name) if name in ORDER else len(ORDER)
        return place, name, [_sortable(found[run].get(key)) for key in keys]

    made: dict[str, str] = {}
    behind: dict[str, list[Any]] = {}  # label -> the different values that it stands for
    for run in sorted(found, key=order):
        values = [found[run].get(key) for key in keys]
        alike = behind.setdefault(label := _label(found[run], head, keys), [])
        if values not in alike:
            alike.append(values)
        place = alike.index(values)
        made[run] = f"{label} ({place + 1})" if place else label
    return made


def _varied(settings: Sequence[Options], head: str) -> list[str]:
    """Options that differ between runs of one `head`, without options that follow from an earlier one."""
    texts = [{key: json.dumps(value) for key, value in each.items()} for each in settings]

    def values(*keys: str) -> int:
        return len({tuple(each.get(key) for key in keys) for each in texts})

    kept = [head]
    for key in dict.fromkeys(key for each in settings for key in each if key != CONTENT):
        # As many triples as pairs: the value of `key` follows from the other two.
        if all(values(head, other, key) > values(head, other) for other in kept):
            kept.append(key)
    # Of each file the name is enough, unless it has changed.
    return [*kept[1:], *([CONTENT] if values(*kept, CONTENT) > values(*kept) else [])]


def _label(options: Options, head: str, keys: Sequence[str]) -> str:
    parts = [f"{_short(key)}={_text(options[key])}" for key in keys if options.get(key) is not None]
    name = str(options[head])
    # Z stands for the kernel of the paper.
    return ", ".join(parts if name == "random_support" else [name, *parts])


def _sortable(value: Any) -> tuple[float, str]:
    """Numbers by size, 0.16 before 0.2; other values after them by their text."""
    number = isinstance(value, (int, float))
    return (float(value), "") if number else (math.inf, json.dumps(value))


def _short(key: str) -> str:
    return SHORT.get(key) or re.sub(r"^(algo|kernel|grid)\.", "", key)


def _text(value: Any) -> str:
    if isinstance(value, list):
        return "x".join(map(str, value)) if len(value) == 2 else f"a list of {len(value)}"
    return f"{value:g}" if isinstance(value, float) else str(value)
