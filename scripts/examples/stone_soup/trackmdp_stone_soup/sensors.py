"""A Stone Soup sensor for each cell, and a sensor manager that switches on the sensors of a policy."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime
from typing import Any

import numpy as np
import torch
from stonesoup.base import Property
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.platform.base import FixedPlatform
from stonesoup.sensor.sensor import Sensor
from stonesoup.sensormanager.action import Action, ActionableProperty, ActionGenerator
from stonesoup.sensormanager.base import SensorManager
from stonesoup.types.detection import TrueDetection
from stonesoup.types.groundtruth import GroundTruthState
from stonesoup.types.state import State
from stonesoup.types.track import Track
from stonesoup.types.update import Update

from trackmdp import Policy
from trackmdp.arrays.types import BoolArray
from trackmdp.errors import UserError
from trackmdp_stone_soup.places import Places


class _Switch(Action):
    def act(self, current_time: datetime, timestamp: datetime, init_value: bool, **_: Any) -> bool:
        return bool(self.target_value)


class _Switches(ActionGenerator):
    """Off or on."""

    def __contains__(self, item: Any) -> bool:
        return item in (False, True)

    def __iter__(self) -> Iterator[_Switch]:
        for value in (False, True):
            yield _Switch(generator=self, end_time=self.end_time, target_value=value)

    @property
    def default_action(self) -> _Switch:
        """Off, which costs nothing."""
        return next(iter(self))


class CellSensor(Sensor):
    """The sensor of one cell: while it is on, it reports a target in its cell, always, at the cell's middle."""

    cell: int = Property(doc="Number of the cell.")
    places: Places = Property(doc="Places of the cells.")
    on: bool = ActionableProperty(generator_cls=_Switches, default=False, doc="Whether it is on.")

    @classmethod
    def grid(cls, places: Places) -> list[FixedPlatform]:
        """A platform in the middle of every cell, with its sensor, all of them off."""
        platforms = []
        for cell in range(places.num_cells):
            state = State(places.centre(cell), timestamp=places.start)
            sensor = cls(cell=cell, places=places)
            platforms.append(FixedPlatform(states=state, position_mapping=(0, 1), sensors=[sensor]))
        return platforms

    @property
    def measurement_model(self) -> LinearGaussian:
        """The middle of the cell, with the variance of a uniform place in it, side² / 12."""
        spread = np.eye(2) * self.places.side**2 / 12
        mapping = self.places.mapping
        return LinearGaussian(ndim_state=max(mapping) + 1, mapping=mapping, noise_covar=spread)

    def measure(
        self, ground_truths: set[GroundTruthState], noise: Any = False, **_: Any
    ) -> set[TrueDetection]:
        """A report of each target in its cell, without noise; none while it is off."""
        centre, model = self.places.centre(self.cell), self.measurement_model
        return {
            TrueDetection(
                centre, measurement_model=model, timestamp=truth.timestamp, groundtruth_path=truth
            )
            for truth in ground_truths
            if self.on and self.places.cell(truth) == self.cell
        }


class PolicySensorManager(SensorManager):
    """Switches on the sensors that a policy chooses for each track.

    A track has one state a step: an `Update` where its target was located, another state where it was missed. From
    them the last located cell and the misses since then are read; after t_max + 1 misses all sensors are on (the safe
    action). With several tracks a sensor is on if it is chosen for one of them.
    """

    policy: Policy = Property(doc="A deterministic policy of the last located cell.")
    places: Places = Property(doc="Places of the cells.")

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        task = self.policy.task
        perfect = task.perfect and task.safe and task.coverage is None
        if not self.policy.deterministic or task.order or not perfect:
            expected = "a deterministic one of the last cell, and one sensor a cell without misses"
            raise UserError(f"policy: expected {expected}")

    def known(self, track: Track) -> tuple[int, int]:
        """The cell in which a track's target was last located, and the misses since then."""
        states = enumerate(reversed(track.states))
        misses = next(n for n, state in states if isinstance(state, Update))
        return self.places.cell(track[len(track) - 1 - misses]), misses

    def chosen(self, track: Track) -> BoolArray:
        """`[M]` the sensors for one track."""
        cell, misses = self.known(track)
        if misses > self.policy.task.t_max:
            return np.ones(self.policy.task.num_cells, dtype=bool)
        return self.policy.act(torch.tensor([cell]), torch.tensor([misses]))[0].numpy()

    def choose_actions(
        self, tracks: Iterable[Track], timestamp: datetime, nchoose: int = 1, **_: Any
    ) -> list[dict[CellSensor, list[Action]]]:
        """`nchoose` times the same: for each sensor whether it is on until `timestamp`."""
        on = np.any([self.chosen(track) for track in tracks], axis=0)
        switched = {}
        for sensor in self.sensors:
            (generator,) = sensor.actions(timestamp)
            switched[sensor] = [list(generator)[int(on[sensor.cell])]]
        return [switched] * nchoose
