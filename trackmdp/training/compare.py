"""Policies side by side on one problem: figures, differences with intervals, and the conclusion in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias, TypeVar

import numpy as np

from trackmdp.errors import UserError
from trackmdp.notebook.card import Card, Carded, counted_words, decimal, percent
from trackmdp.policies.table import PolicyTable
from trackmdp.recordings.tracks import Recorded
from trackmdp.solvers.evaluate import group_rule, policy_table
from trackmdp.solvers.several.group_value import evaluate_group
from trackmdp.solvers.several.merging import Rule
from trackmdp.solvers.value import replay, value_of
from trackmdp.statistics import FEWEST, MeanInterval, ratio
from trackmdp.training.evaluator import estimated_qmdp
from trackmdp.world.group import Group, Subject, check_problem

FIGURES = ("aihtr", "accuracy", "sensors_per_step")
Figures: TypeAlias = dict[str, MeanInterval]

_SAME = 1e-9
"""Relative difference of two exact values below which they are the same up to rounding."""
_PLAYED = 1_000
"""Episodes of several targets where the first policy's figures are exact and others' are not."""


@dataclass(frozen=True)
class Compared:
    """A policy in a comparison.

    Attributes:
        name: of the policy.
        figures: `FIGURES` -> its value, exact, or a mean over tracks with its interval.
        difference: AIHTR less the first policy's; an interval from one end to itself where it is exact.
    """

    name: str
    figures: Figures
    difference: MeanInterval


@dataclass(frozen=True, repr=False)
class Comparison(Carded):
    """Policies on one problem.

    Attributes:
        policies: in the order given; differences are to the first.
        tracks: held-out tracks that the figures are means over; None where they are exact.
        units: the word for one of these, and what follows it; of several targets groups of tracks, or episodes.
    """

    policies: tuple[Compared, ...]
    tracks: int | None
    units: tuple[str, ...] = ("held-out track",)

    @property
    def about(self) -> str:
        """What the figures are means over."""
        return "exact" if self.tracks is None else counted_words(self.tracks, *self.units)

    def card(self) -> Card:
        """A line for each policy; differences are to the first."""
        facts = {}
        for each in self.policies:
            aihtr, accuracy, sensors, difference = self.cells(each)
            last = "" if each is self.policies[0] else f"; Δ {difference}"
            facts[each.name] = f"AIHTR {aihtr}, {accuracy}, {sensors} sensors{last}"
        head = f"Comparison: {len(self.policies)} policies, {self.about}; Δ: AIHTR less the first's"
        return Card(head, facts)

    def cells(self, row: Compared) -> list[str]:
        """AIHTR, accuracy, sensors per step and the difference to the first policy, in words."""
        aihtr, accuracy, sensors = (row.figures[name].mean for name in FIGURES)
        shown = [decimal(aihtr), percent(accuracy), decimal(sensors, 2)]
        less = row.difference
        difference = decimal(less.mean)
        if less.low != less.high:
            difference += f" ({decimal(less.low)} ... {decimal(less.high)})"
        return [*shown, "–" if row is self.policies[0] else difference]

    @property
    def sentences(self) -> list[str]:
        """The conclusion for each policy but the first."""
        first, *others = self.policies
        exact = self.tracks is None
        unit = "episode" if exact else self.units[0].split()[-1]
        return [_sentence(first, each, unit, exact=exact) for each in others]


def _sentence(first: Compared, other: Compared, unit: str, *, exact: bool) -> str:
    """The difference of a policy to the first, and whether it is shown."""
    found = other.difference
    more = f"{decimal(abs(found.mean))} {'more' if found.mean > 0 else 'less'} per {unit}"
    if exact:
        same = abs(found.mean) <= _SAME * max(abs(first.figures["aihtr"].mean), 1.0)
        return (
            f"{other.name} earns {'the same as' if same else f'{more} than'} {first.name} (exact)."
        )
    low, high = found.mean - _SAME, found.mean + _SAME
    interval = f"all {unit}s agree" if found.n >= FEWEST else f"too few {unit}s for an interval"
    if found.low is not None and found.high is not None:
        low, high = found.low, found.high
        interval = f"95 % interval of the difference: {decimal(low)} to {decimal(high)}"
    if low <= 0.0 <= high:
        return f"No difference between {other.name} and {first.name} is shown; {interval}."
    return f"{other.name} earns {more} than {first.name}; {interval}."


def compare(problem: Subject, policies: Mapping[str, Any] | Sequence[Any]) -> Comparison:
    """Value policies on one problem: exactly on a world, paired over the held-out tracks on recorded ones.

    Of several targets differences are paired as well: over simulated episodes with the same targets, as many as the
    first policy's reward per step needs to be known to .005, or over groups of held-out tracks.

    Args:
        problem: a world, recorded tracks, or a `Group` of targets.
        policies: name -> policy, or a list; each as for `tm.evaluate`, or the name of a baseline.

    Raises:
        UserError: fewer than two policies, or one that `tm.evaluate` refuses; the message names it.

    Example:
        >>> from trackmdp import Policy, make_world
        >>> world = make_world(size=3)
        >>> compare(world, ["all_on", Policy.none(world)]).sentences
        ['Policy 2 earns 58.520 more per episode than all_on (exact).']
    """
    check_problem(problem, "compare")
    if isinstance(policies, str) or not isinstance(policies, Iterable):
        raise UserError(
            f"compare: a {type(policies).__name__}, expected a list or dict of policies"
        )
    named = policies if isinstance(policies, Mapping) else _named(policies)
    if len(named) < 2:
        raise UserError(f"compare: {len(named)} policies, expected at least two")
    if isinstance(problem, Group):
        return _of_group(problem, _made(problem, named, partial(group_rule, problem)))
    tables = _made(problem, named, partial(policy_table, problem))
    if problem.recorded is not None:
        return _on_tracks(problem.recorded, tables)
    found = {name: value_of(problem, table) for name, table in tables.items()}
    first, *_ = found.values()
    rows = (
        Compared(
            name,
            {key: _exact(getattr(each, key)) for key in FIGURES},
            _exact(each.aihtr - first.aihtr),
        )
        for name, each in found.items()
    )
    return Comparison(tuple(rows), None)


def _on_tracks(problem: Recorded, tables: Mapping[str, PolicyTable]) -> Comparison:
    """Figures over the held-out tracks; each target's own difference makes up the differences."""
    tracks = problem.held_out.limited(problem.max_steps)
    target = np.unique(tracks.names, return_inverse=True)[1]
    count = np.bincount(target).astype(np.float64)
    found = {name: replay(problem, tracks, table) for name, table in tables.items()}
    rewards = {
        name: np.bincount(target, each.totals[:, 0]).astype(float) for name, each in found.items()
    }
    first, *_ = rewards.values()
    rows = []
    for name, each in found.items():
        figures = each.intervals(tracks.names)
        less = _spread(ratio(rewards[name] - first, count))
        rows.append(Compared(name, {key: figures[key] for key in FIGURES}, less))
    return Comparison(tuple(rows), len(tracks))


def _of_group(group: Group, rules: Mapping[str, Rule]) -> Comparison:
    """Figures of policies for several targets; the same targets for all of them."""
    found = {name: evaluate_group(rule) for name, rule in rules.items()}
    first, *_ = found.values()
    if not (exact := all(each.exact for each in found.values())) and group.recorded is None:
        # No more than the first needs, so that episodes are the same for all.
        count = len(first.totals) if not first.exact else _PLAYED
        found = {name: evaluate_group(rule, episodes=count) for name, rule in rules.items()}
        first, *_ = found.values()
    rows = tuple(
        Compared(
            name, {key: getattr(each, key) for key in FIGURES}, _spread(each.less(first).aihtr)
        )
        for name, each in found.items()
    )
    units = first.units
    if not exact and group.recorded is None:
        # A figure that is exact, or has control variates, is no plain mean: differences are not those of the figures.
        units = (*units, ", differences over the same targets")
    return Comparison(rows, None if exact else len(first.totals), units)


def _spread(less: MeanInterval) -> MeanInterval:
    """A difference without an interval where all units agree: no spread is no estimate of the spread.

    An exact one, of a single unit, stays.
    """
    if less.n == 1 or less.low is None or less.high is None:
        return less
    agree = less.high - less.low <= _SAME * max(abs(less.mean), 1.0)
    return replace(less, low=None, high=None) if agree else less


M = TypeVar("M")


def _made(problem: Subject, policies: Mapping[str, Any], make: Callable[[Any], M]) -> dict[str, M]:
    """What `make` makes of the policies, by their names."""
    found = {}
    for name, policy in policies.items():
        try:
            # Q_MDP needs a motion model; on recorded tracks it has the kernel estimated from them.
            if isinstance(policy, str) and policy == "qmdp" and problem.recorded is not None:
                policy = estimated_qmdp(problem.recorded)
            found[name] = make(policy)
        except UserError as error:
            raise UserError(f"compare: {name}: {error}") from error
    return found


def _exact(value: float) -> MeanInterval:
    return MeanInterval(value, value, value, 1)


def _named(policies: Sequence[Any]) -> dict[str, Any]:
    """A name for each: a baseline's own, else its class and place."""
    return {
        each if isinstance(each, str) else f"{type(each).__name__} {place}": each
        for place, each in enumerate(policies, start=1)
    }
