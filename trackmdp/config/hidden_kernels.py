"""Schema of the kernels of targets with a hidden mode: heading, regimes, velocity."""

from __future__ import annotations

import re
from typing import Any

from trackmdp.config.checks import build_config, validate
from trackmdp.config.options import (
    GROUPS,
    TABLE,
    Option,
    choice,
    file_option,
    option,
    refuse,
    require_able,
    share_option,
)
from trackmdp.config.registry import choice_values, resolved
from trackmdp.config.world import KernelConfig

MOST_MODES = 1_000
"""Velocities, or velocities and turns; the states of a target are as many times the cells."""

_FARTHEST = 1_000_000
"""Cells, or velocities, from one step to the next: of much larger numbers rounding leaves no probabilities."""


class HiddenKernelConfig(KernelConfig):
    """Base of the kernels with a mode; the code of a choice returns a kernel on (cell, mode), and the number of modes.

    `reveals` is no argument of it.
    """

    hides = True
    reveals: bool = option(
        "whether a detection reveals the mode as well (Doppler, AIS); false: the cell alone"
    )

    def check(self, key: str, root: Any) -> None:
        """Of the learners those with a memory take modes."""
        require_able(root, "remembers", f"with kernel={self.name}")


@choice("kernel", "heading", makes="trackmdp.motion.modes:heading_kernel")
class HeadingConfig(HiddenKernelConfig):
    """A target with one of eight headings, hidden from the tracker; at the border it turns back."""

    keep: float = share_option(
        "probability of keeping the heading; else it turns by 45 degrees", unit="per step"
    )
    go: float = share_option(
        "probability of moving one cell that way; else it stays", unit="per step"
    )
    exit_probability: float = option("probability of leaving the grid", unit="per step", gt=0, lt=1)


@choice("kernel", "regimes", makes="trackmdp.motion.modes:regimes")
class RegimesConfig(HiddenKernelConfig):
    """A target that switches between other kernels, such as to linger and to travel; the one in force is its mode.

    It switches first, then moves by the new regime, with the border and the exit of that.
    """

    stay: Any = option(
        "probability of staying in the regime, for all or for each; else any of the others is as likely",
        unit="per step",
        expects="a number from 0 to 1, or a list of one per regime",
    )
    regimes: Any = file_option(
        "two or more kernels: {kernel: NAME, OPTION: VALUE, ...}, the rest as in conf/, or a table's file",
        "a list, each {kernel: NAME, OPTION: VALUE, ...} or a path to a .npy, .npz or .csv file",
    )

    def check(self, key: str, root: Any) -> None:
        """Each regime is a kernel of cells that exists, with its own options; those left out are filled in."""
        super().check(key, root)
        if not isinstance(self.regimes, list) or not 2 <= len(self.regimes) <= MOST_MODES:
            raise refuse(f"{key}.regimes", self.regimes, f"a list of 2 to {MOST_MODES:,} kernels")
        self.regimes = [
            _regime(f"{key}.regimes[{place}]", entry, root)
            for place, entry in enumerate(self.regimes)
        ]
        shares = self.stay if isinstance(self.stay, list) else [self.stay] * len(self.regimes)
        if len(shares) != len(self.regimes):
            expected = f"one number, or {len(self.regimes)} (one per regime)"
            raise refuse(f"{key}.stay", self.stay, expected)
        if not all(map(Option("", ge=0, le=1, kind=float).allows, shares)):
            raise refuse(f"{key}.stay", self.stay, "numbers from 0 to 1")


class VelocityConfig(HiddenKernelConfig):
    """Common options of the kernels in metres and seconds.

    At the border the target turns back: it stays in its cell, with the opposite velocity.
    """

    cell: float = option("side of a cell; by default grid.cell", unit="m", gt=0)
    step: float = option("time from one step to the next", unit="s", gt=0, le=1e9)
    speed: float = option(
        "greatest speed along rows, and along columns; a faster target has that", unit="m/s", gt=0
    )
    spacing: float = option(
        "distance of two velocities: the modes are multiples of it", unit="m/s", gt=0
    )
    noise: float = option(
        "standard deviation of the acceleration along rows, and along columns, the same for one step (discrete white "
        "noise)",
        unit="m/s²",
        ge=0,
    )
    exit_probability: float = option("probability of leaving the grid", unit="per step", gt=0, lt=1)

    def check(self, key: str, root: Any) -> None:
        """At least one velocity, and at most `MOST_MODES`; a step in proportion to them and to the cells."""
        super().check(key, root)
        if self.spacing > self.speed:
            raise refuse(f"{key}.spacing", self.spacing, f"at most {key}.speed={self.speed:g}")
        levels = 2 * self.speed / self.spacing + 1
        if (modes := levels * levels) > MOST_MODES:  # not **, which raises where it overflows
            expected = (
                f"more: with {key}.speed={self.speed:g} these are {modes:,.0f} velocities, "
                f"{MOST_MODES:,} at most"
            )
            raise refuse(f"{key}.spacing", self.spacing, expected)
        for name, ratio, of in (
            ("speed", self.speed * self.step / self.cell, "cells"),
            ("noise", self.noise * self.step / self.spacing, f"times {key}.spacing"),
        ):
            if not ratio <= _FARTHEST:  # nan as well
                expected = f"less: with {key}.step={self.step:g} that is {ratio:.3g} {of}, {_FARTHEST:,} at most"
                raise refuse(f"{key}.{name}", getattr(self, name), expected)


@choice("kernel", "constant_velocity", makes="trackmdp.motion.modes:constant_velocity")
class ConstantVelocityConfig(VelocityConfig):
    """Nearly constant velocity, the mode, in metres and seconds; displacements have its mean exactly, never rounded."""


@choice("kernel", "coordinated_turn", makes="trackmdp.motion.modes:coordinated_turn")
class CoordinatedTurnConfig(VelocityConfig):
    """As constant_velocity, but the target turns left, right or not at all; turn and velocity are the mode."""

    turn_rate: float = option("how fast it turns", unit="degrees/s", gt=0, le=180)
    stay: float = share_option(
        "probability of going on as it turns; else the other two are as likely"
    )


def _regime(key: str, entry: Any, root: Any) -> dict[str, Any]:
    """One regime with all its options, checked; defaults are those of `conf/`.

    Raises:
        UserError: there is no such kernel of cells, or an option is not allowed.
    """
    if isinstance(entry, str) and re.fullmatch(TABLE, entry):
        entry = {"kernel": "table", "path": entry}
    known = [
        name for name, schema in GROUPS["kernel"].items() if schema.is_motion and not schema.hides
    ]
    if not isinstance(entry, dict) or "kernel" not in entry:
        raise refuse(
            key, entry, "{kernel: NAME, OPTION: VALUE, ...}, or a path to a .npy, .npz or .csv file"
        )
    given = dict(entry)
    if (name := given.pop("kernel")) not in known:
        raise refuse(f"{key}.kernel", name, f"one of {', '.join(known)}")
    plain = resolved(choice_values("kernel", name) | given)
    node = build_config(plain, GROUPS["kernel"][name], f"{key}.")
    return {"kernel": name} | vars(validate(node, key, root))
