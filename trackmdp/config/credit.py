"""Schema of the algorithms with a credit per sensor: hindsight, and A2C, PPO and DQN with the same gains."""

from __future__ import annotations

from typing import Any

from trackmdp.config.learning import (
    ENTROPY,
    LEARNING_RATE,
    EveryTaskConfig,
    ScheduleConfig,
    networks,
    renewed_table,
)
from trackmdp.config.options import (
    BYTES,
    TABLE,
    Needs,
    Reasons,
    choice,
    count_option,
    file_option,
    nested,
    option,
    refuse,
)


class PerSensorConfig(EveryTaskConfig):
    """Common options of the algorithms with a credit per sensor.

    `explore`, read with `collect=mixed`: the probability of sensing everything where the target is located, in the
    course of the frames. Learning starts where it begins to change.
    """

    effort = 1.0
    collect: str = option(
        "all sensors on; or mixed with the policy learned so far, which costs less and shows less",
        choices=("all_on", "mixed"),
    )
    explore: ScheduleConfig = nested("with collect=mixed, share of the steps with all sensors on")
    gamma: float = option(
        "discount inside the credit; policies are evaluated undiscounted", ge=0, lt=1
    )
    learning_rate: ScheduleConfig = nested(LEARNING_RATE)
    blend: ScheduleConfig = nested(
        "λ, weight of the reward of the policy itself after a miss in the gain of a detection; the rest is the "
        "clocked bound, which is optimistic"
    )
    ema_decay: float = option(
        "decay of the exponential moving average of the actor, which is evaluated", ge=0, lt=1
    )
    batch_size: int = count_option(
        "path segments per update; a quarter as many where they are whole sensed paths",
        unit="segments",
    )
    updates: int | None = count_option(
        "updates of the whole run; null: by the size of the problem", le=10**9
    )
    updates_per_iteration: int = count_option("most updates between evaluations or log rows")
    hidden: int | None = option(
        "units of each net's hidden layer, 0 = plain tables without one; null: by the size of the problem, from 4,097 "
        "cells on tables",
        unit="units",
        ge=0,
        le=4096,
    )
    buffer_size: int = count_option("path segments kept for replay", unit="segments")
    share_cells: str = file_option(
        "assume that the target moves alike from all cells, or from those of one class, and learn one policy for all "
        "with the same surroundings; with one price for all sensors",
        "all, none, or a path to a .npy, .npz or .csv file of the class of each cell",
        pattern=f"all|none|{TABLE}",
        words=("all", "none"),
    )
    exchange: bool = option(
        "with collect=all_on: at the end, change learned sets jointly where it pays on other paths than those that "
        "propose it; whole ones, a quarter kept from learning, where the next move does not depend on the cell alone"
    )
    max_entries: int = count_option(
        "entries (located cell, misses, sensor) of the losses' tables at once; larger ones are gone through in parts",
        unit="entries",
    )

    def check(self, key: str, root: Any) -> None:
        """`explore` is a probability."""
        for end in ("start", "end"):
            if (share := getattr(self.explore, end)) > 1:
                raise refuse(f"{key}.explore.{end}", share, "a number from 0 to 1, a probability")

    def ignored(self, root: Any) -> Reasons:
        """All sensors on leave nothing to explore."""
        return {} if self.collect == "mixed" else {"explore": "with algo.collect=all_on"}

    def needs(self, task: Any, root: Any) -> Needs:
        """The moves kept, and their sorting; the paths of one update; the networks; the table that explores.

        A move is two cells of 16 bits. Where moves of different paths do not combine (`markov`), a third number
        marks the ones that go on; paths of t_max + 3 cells, longer ones where a policy remembers detections, are kept
        as well, and the results of exchange on whole paths, for each detection that may be on them.
        """
        longer = 0 if task.markov else 2 * (task.order + 2) * (task.t_max + 2) - 2
        length = task.t_max + 3 + longer
        moves = min(self.buffer_size, root.collector.total_frames)
        whole, events = self.exchange * (task.t_max + 2) * 12, (task.t_max + 3) ** task.order
        alone = task.markov and not task.order
        cells, numbers = (2, 5) if alone else (length + 3, 8 + whole * events)
        return {
            "algo.buffer_size": moves * (cells * BYTES["int16"] + numbers * BYTES["int64"]),
            # Each cell of a path, and about five numbers that are gathered for it.
            "algo.batch_size": self.batch_size * length * 6 * BYTES["int64"],
            "algo.hidden": networks(task, self.hidden),
            "grid.size": renewed_table(task) if self.collect == "mixed" else 0,
        }


@choice("algo", "hindsight", makes="trackmdp.algos.hindsight:Hindsight")
class HindsightConfig(PerSensorConfig):
    """Collect with all sensors on, then learn on those paths from the detections and misses of every policy."""


class PolicyGradientConfig(PerSensorConfig):
    """Common options of A2C and PPO with a credit per sensor."""

    effort = 1.6
    entropy: ScheduleConfig = nested(ENTROPY)


@choice("algo", "a2c_per_sensor", makes="trackmdp.algos.per_sensor:PerSensorA2C")
class A2cPerSensorConfig(PolicyGradientConfig):
    """Hindsight with the policy gradient of A2C, over both actions of every sensor."""


@choice("algo", "ppo_per_sensor", makes="trackmdp.algos.per_sensor:PerSensorPPO")
class PpoPerSensorConfig(PolicyGradientConfig):
    """Hindsight with the clipped surrogate of PPO, per sensor."""

    clip_epsilon: float = option("how far a sensor's probability ratio may leave 1", gt=0, lt=1)
    minibatches: int = count_option(
        "parts of a batch: updates until the old policy of the ratio is renewed"
    )
    surrogate: str = option(
        "over both actions of every sensor, or over sets drawn from the old policy",
        choices=("all_action", "sampled"),
    )


@choice("algo", "dqn_per_sensor", makes="trackmdp.algos.per_sensor:PerSensorDQN")
class DqnPerSensorConfig(PerSensorConfig):
    """Hindsight with a Q that adds up over the sensors, for DQN."""
