"""Schema of several targets in one grid."""

from __future__ import annotations

from typing import Any

from trackmdp.config.options import NodeConfig, Reasons, count_option, option, refuse

MOST_TARGETS = 1_000
"""Targets in one grid: of more, each step and each bound would take minutes."""


class TargetsConfig(NodeConfig):
    """Targets that are in the grid at the same time: labelled, independent, alike in their motion."""

    count: int = count_option(
        "K; they share the sensors, which are paid once while any of them is in the grid",
        unit="targets",
        le=MOST_TARGETS,
    )

    def check(self, key: str, root: Any) -> None:
        """Several targets are followed in whole episodes, each by the cell of its last detection."""
        if self.count == 1:
            return
        # Each of these makes a single target's plan depend on more than its own cell and clock.
        with_several = f"with {key}.count={self.count}"
        hides = root.kernel.hides
        if hides and not root.kernel.reveals and root.cost.budget is not None:
            both = f"null with hidden modes and {key}.count={self.count}"
            raise refuse("cost.budget", root.cost.budget, both)
        if root.sensor.name == "false_alarm":
            raise refuse("sensor", root.sensor.name, f"perfect, miss or footprint {with_several}")
        learner: Any = getattr(root, "algo", None)
        joint = learner is not None and learner.joint
        if joint and root.grid.window is not None:
            every = f"null with algo={learner.name} {with_several}: all sensors can be chosen"
            raise refuse("grid.window", root.grid.window, every)
        # The union of all targets' own sets, on recorded tracks and with modes, needs no prediction.
        united = (hides or not root.kernel.is_motion) and not joint and root.cost.budget is None
        own = root.task.memory if united else "cell"
        for place, value, expected in (
            ("kernel.reveals", joint and hides and root.kernel.reveals, False),
            ("task.memory", root.task.memory, own),
            ("cost.mean_budget", getattr(root.cost, "mean_budget", None), None),
            ("verify", getattr(root, "verify", False), False),
        ):
            if value != expected:
                raise refuse(
                    place, value, f"{str(expected).lower().replace('none', 'null')} {with_several}"
                )


class MergedTargetsConfig(TargetsConfig):
    """Several targets, and how policies of single ones are put together."""

    merge: str | None = option(
        "gains: a sensor is on where the gains of all targets together exceed its price; union: the sensors of all "
        "targets' own sets; null: gains, but union on recorded tracks, with hidden modes, and of all_on and none",
        choices=("gains", "union"),
    )

    def ignored(self, root: Any) -> Reasons:
        """One target needs no merging, and no more does a policy that was learned for all."""
        algo: Any = getattr(root, "algo", None)
        if algo is not None and algo.joint:
            return {"merge": f"with algo={algo.name}, which learns of all targets together"}
        unknown = getattr(root, "run", None) is not None  # a run has a number of its own
        return {} if self.count > 1 or unknown else {"merge": "with targets.count=1"}


class WidthConfig(NodeConfig):
    """Accuracy of figures that are simulated."""

    width: float = option(
        "with several targets: half of the 95 % interval of the reward per step",
        unit="reward",
        gt=0,
    )

    def ignored(self, root: Any) -> Reasons:
        """Figures of one target are exact."""
        known = getattr(root, "run", None) is None
        return {"width": "with targets.count=1"} if known and root.targets.count == 1 else {}
