"""The frontier of accuracy against sensors: its corners, mixtures of two of them, and a proved bound above it.

An episode of a policy comes to so many detections, sensors and safe actions. The target's motion does not depend on the
policy, so the steps in the grid are N for every policy, and per step all three are divided by the same N. With s the
sensors per step and

    net = accuracy - (D / r) · safe actions per step,

the AIHTR at a price c of a sensor is r N (net - (c / r) s): policies are points (s, net), prices are slopes, and an
upper bound U on the AIHTR at a price c is a line that no policy lies above, net <= U / (r N) + (c / r) s. One of two
policies, drawn at the start of each episode, gives any point of their chord, so that the frontier is concave. Where
D = 0, net is the accuracy itself. The safe action counts as no sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np

from trackmdp.arrays.numbers import REAL
from trackmdp.arrays.types import Array
from trackmdp.errors import UserError
from trackmdp.notebook.card import Card, Carded, decimal, percent
from trackmdp.solvers.solution import Solution

ROUNDING = 1e-10
"""Height above a chord, relative to the figures, that counts as rounding."""


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Corner(Solution):
    """A policy at a corner of the frontier: the solution at the price at which it was found.

    Attributes:
        price: c, of a sensor for one step.
        sensors: sensors per step in the grid; where their prices differ, each counts as its price over the mean one.
        net: accuracy less D / r for each safe action, per step in the grid.
    """

    price: float
    sensors: float
    net: float

    def card(self) -> Card:
        """The price, above the card of the solution."""
        card = super().card()
        title = card.title.replace("Solution", "Corner", 1)
        return Card(title, {"price of a sensor": f"{self.price:g}"} | card.facts)

    @property
    def accuracy(self) -> float:
        """Detections per step in the grid, forced ones included."""
        return self.evaluation.accuracy


@dataclass(frozen=True, eq=False, repr=False)
class Mixture(Carded):
    """A draw between two neighbouring corners at the start of each episode, or one of them alone.

    Attributes:
        parts: probability and corner; first the corner at or above the value asked for.
        accuracy: detections per step in the grid.
        sensors: sensors per step in the grid.
        net: accuracy less D / r for each safe action.
    """

    parts: list[tuple[float, Corner]]
    accuracy: float
    sensors: float
    net: float

    def card(self) -> Card:
        """The figures, and each corner with its probability."""
        facts = {
            "accuracy": percent(self.accuracy),
            "sensors per step": decimal(self.sensors, 4),
            "net": decimal(self.net, 4),
        }
        for weight, corner in self.parts:
            facts[f"with probability {weight:.4f}"] = (
                f"the corner at price {corner.price:g}, {corner.sensors:.4f} sensors per step"
            )
        return Card("Mixture: one policy, drawn at the start of each episode", facts)

    @classmethod
    def of(cls, *parts: tuple[float, Corner]) -> Mixture:
        """The mixture of corners that are drawn with these probabilities."""
        drawn = [(weight, corner) for weight, corner in parts if weight > 0]
        means = (
            sum(weight * getattr(corner, name) for weight, corner in drawn)
            for name in ("accuracy", "sensors", "net")
        )
        return cls(drawn, *means)


@dataclass(frozen=True, eq=False, repr=False)
class Tradeoff(Carded):
    """The frontier of a world at a fixed D.

    Attributes:
        corners: by rising sensors, and so by falling price; the last one is the best at price 0.
        slopes: `[L]`, c / r of each price that was solved for, the corners' prices among them.
        bounds: `[L]`, upper bound on the AIHTR there, over r N: net <= bounds + slopes · sensors for every policy.
        steps: N, expected steps in the grid per episode, the same for every policy.
        reward: r.
        safe_cost: D, the same at all prices.
        equal_prices: whether every sensor has the same price; else prices keep the ratios of the world's.
        resolution: height above an edge that is not resolved into further corners.
        seconds: time spent.
        interrupted: whether the user stopped the search (Ctrl-C).
    """

    corners: tuple[Corner, ...]
    slopes: Array
    bounds: Array
    steps: float
    reward: float
    safe_cost: float
    equal_prices: bool
    resolution: float
    seconds: float
    interrupted: bool = False

    def card(self) -> Card:
        """The ends of the frontier and its proof."""
        ends = self.corners[0], self.corners[-1]
        facts = {
            "accuracy": " to ".join(percent(corner.accuracy) for corner in ends),
            "sensors per step": " to ".join(decimal(corner.sensors, 2) for corner in ends),
            "prices": " to ".join(f"{corner.price:g}" for corner in reversed(ends)),
            "safe action": f"D = {self.safe_cost:g}",
            "bound": f"{'certified' if self.certified else 'not closed'}; gap {self.gap:.2g}",
            "search": f"{len(self.slopes)} prices, {self.seconds:.2g} s",
        }
        return Card(f"Tradeoff: {len(self.corners)} corners", facts)

    def bound(self, sensors: float) -> float:
        """Proved: no policy, drawn at random or not, with so few sensors per step has a higher `net`."""
        return float((self.bounds + self.slopes * sensors).min())

    def worth(self, sensors: float, price: float = 0.0) -> float:
        """Proved: no policy with at most so many sensors per step has a higher AIHTR at a `price` of a sensor.

        It holds for a budget of each step as for one on average: the price is its multiplier, and the lowest line at
        `sensors` the dual. Where prices differ, `sensors` and `price` are those by price.
        """
        rising = np.maximum(self.slopes - price / self.reward, 0.0)
        return self.reward * self.steps * float((self.bounds + rising * sensors).min())

    @cached_property
    def gaps(self) -> tuple[float, ...]:
        """Proved height of the frontier above the edge from each corner to the next, at most."""
        return tuple(
            height(self.slopes, self.bounds, *pair)
            for pair in zip(self.corners, self.corners[1:], strict=False)
        )

    @property
    def gap(self) -> float:
        """Proved height of the frontier above the corners and their edges, at most."""
        first, last = self.corners[0], self.corners[-1]
        # No policy has fewer sensors than the first corner where that has none, and none a higher net than at price 0.
        ends = self.bound(first.sensors) - first.net, self.bound(last.sensors) - last.net
        return max(0.0, *self.gaps, *ends)

    @property
    def certified(self) -> bool:
        """Whether every corner is certified, and no edge is farther than `resolution` below the frontier.

        Not where it begins above 0 sensors, as after an interruption: nothing is known of fewer than there.
        """
        whole = self.corners[0].sensors == 0 and self.gap <= self.resolution
        return whole and all(corner.certified for corner in self.corners)

    def at(self, *, accuracy: float | None = None, sensors: float | None = None) -> Mixture:
        """The mixture of exactly this accuracy, or of exactly so many sensors per step.

        No policy with as few sensors per step as the mixture has a `net` higher by more than `gap`: where D = 0, none
        is more accurate. Above the last corner's sensors, that corner is used alone.

        Args:
            accuracy: fraction of steps at which the target is located, up to the last corner's.
            sensors: sensors per step, from 0.

        Raises:
            UserError: neither or both are given, or the value is not attained.

        Example:
            >>> from trackmdp.solvers.frontier import frontier
            >>> from trackmdp.world.make import make_world
            >>> round(frontier(make_world("drift", size=3)).at(accuracy=0.9).accuracy, 9)
            0.9
        """
        asked: dict[str, Any] = {"accuracy": accuracy, "sensors": sensors}
        given = {name: value for name, value in asked.items() if value is not None}
        if len(given) != 1:
            raise UserError(f"expected exactly one of accuracy and sensors, got {len(given)}")
        ((name, wanted),) = given.items()
        if not isinstance(wanted, REAL):
            raise UserError(f"{name}: a {type(wanted).__name__}, expected a number")
        values = [getattr(corner, name) for corner in self.corners]
        if name == "sensors" and wanted >= values[-1]:
            return Mixture.of((1.0, self.corners[-1]))
        return self._mixture(name, float(wanted), values)

    def _mixture(self, name: str, wanted: float, values: Sequence[float]) -> Mixture:
        """The first corner of at least the wanted value, with as much of the corner before as fits."""
        lowest, highest = (0.0, 1.0) if name == "accuracy" else (values[0], np.inf)
        # A sum of hundreds of terms: an accuracy of 1 may be attained but for the last digits.
        reached = [value >= wanted - 1e-9 for value in values]
        if not lowest <= wanted <= highest or not any(reached):
            most = f" to {max(values):.6g}" if name == "accuracy" else ""
            raise UserError(f"{name}={wanted}: expected a number from {lowest:g}{most}")
        place = reached.index(True)
        if place == 0:
            return Mixture.of((1.0, self.corners[0]))
        below, above = values[place - 1 : place + 1]
        weight = min(1.0, (wanted - below) / (above - below))
        return Mixture.of((weight, self.corners[place]), (1.0 - weight, self.corners[place - 1]))


class Placed(Protocol):
    """Whatever has a place in the plane of the frontier."""

    @property
    def sensors(self) -> float:
        """Sensors per step."""

    @property
    def net(self) -> float:
        """Height."""


P = TypeVar("P", bound=Placed)


def upper_hull(found: Sequence[P]) -> list[P]:
    """Corners of the concave hull up to the greatest net, by rising sensors; points on an edge are none."""
    hull: list[P] = []
    for corner in sorted(found, key=lambda each: (each.sensors, -each.net)):
        # More sensors have to bring more.
        if hull and corner.net <= hull[-1].net + ROUNDING * max(1.0, abs(corner.net)):
            continue
        while len(hull) > 1 and not _bends(hull[-2], hull[-1], corner):
            hull.pop()
        hull.append(corner)
    return hull


def _bends(left: Placed, middle: Placed, right: Placed) -> bool:
    """Whether the middle one of three lies above the chord of the others."""
    share = (middle.sensors - left.sensors) / max(right.sensors - left.sensors, 1e-300)
    chord = left.net + share * (right.net - left.net)
    return middle.net > chord + ROUNDING * max(1.0, abs(middle.net))


def slope(left: Corner, right: Corner) -> float:
    """Net per sensor along an edge."""
    return (right.net - left.net) / (right.sensors - left.sensors)


def height(slopes: Array, bounds: Array, left: Corner, right: Corner) -> float:
    """The most that the lines net = bounds + slopes · sensors allow above the edge between two corners.

    Above the chord the lines are u + k s with k >= 0 or k <= 0. A rising line i and a falling line j leave at most the
    height at which they meet, (k_i u_j - k_j u_i) / (k_i - k_j), and all lines together the least of these.
    """
    chord = slope(left, right)
    k, u = slopes - chord, bounds - (left.net - chord * left.sensors)
    rising, falling = k >= 0, k <= 0
    ki, ui, kj, uj = k[rising, None], u[rising, None], k[falling], u[falling]
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.where(ki > kj, (ki * uj - kj * ui) / (ki - kj), np.inf)
    # a line parallel to the chord meets none of its kind
    flat = u[k == 0]
    return float(min(least.min(initial=np.inf), flat.min(initial=np.inf)))
