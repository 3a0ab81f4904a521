"""Our policies and tracks in Stone Soup: cells as sensors on platforms, and a manager that switches them on.

Needs the extra `stonesoup`. A cell is a square of `side` x `side`; cell 0 has its corner at (0, 0), x goes along the
columns, y along the rows. Step t happens at `start + t * step`, and where a target was before the first one is step 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from trackmdp.episodes.episode import Episode
from trackmdp.errors import UserError, require
from trackmdp.policies.policy import Policy
from trackmdp.world.model import BoolArray, Task
from trackmdp.world.outcomes import Costs
from trackmdp.world.tracks import Tracks, ends_of

require("stonesoup", "stonesoup", "trackmdp.episodes.stone_soup")

from stonesoup.base import Property  # noqa: E402
from stonesoup.metricgenerator.manager import MultiManager  # noqa: E402
from stonesoup.metricgenerator.ospametric import GOSPAMetric  # noqa: E402
from stonesoup.models.measurement.linear import LinearGaussian  # noqa: E402
from stonesoup.platform.base import FixedPlatform  # noqa: E402
from stonesoup.sensor.sensor import Sensor  # noqa: E402
from stonesoup.sensormanager.action import Action, ActionableProperty, ActionGenerator  # noqa: E402
from stonesoup.sensormanager.base import SensorManager  # noqa: E402
from stonesoup.types.detection import TrueDetection  # noqa: E402
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState  # noqa: E402
from stonesoup.types.hypothesis import SingleHypothesis  # noqa: E402
from stonesoup.types.prediction import StatePrediction  # noqa: E402
from stonesoup.types.state import State  # noqa: E402
from stonesoup.types.track import Track  # noqa: E402
from stonesoup.types.update import StateUpdate, Update  # noqa: E402


@dataclass(frozen=True)
class Places:
    """Where the cells of a grid lie, and when its steps are.

    Attributes:
        rows: of the grid.
        columns: of the grid.
        side: of a cell, in the unit of the states' coordinates.
        start: time of step 0.
        step: between two steps.
        mapping: which two numbers of a state vector are x and y.
    """

    rows: int
    columns: int
    side: float = 1.0
    start: datetime = datetime(2000, 1, 1)
    step: timedelta = timedelta(seconds=1)
    mapping: tuple[int, int] = (0, 1)

    @classmethod
    def of(cls, task: Task, **more: Any) -> Places:
        """Those of a task's grid; `more` are further attributes."""
        return cls(*task.size, **more)

    def centre(self, cell: int) -> npt.NDArray[np.float64]:
        """`[2]` x and y of a cell's middle."""
        row, column = divmod(int(cell), self.columns)
        return (np.array([column, row]) + 0.5) * self.side

    def cell(self, state: State) -> int:
        """The cell of a state; M outside the grid."""
        column, row = (int(np.floor(float(state.state_vector[place]) / self.side)) for place in self.mapping)
        inside = 0 <= row < self.rows and 0 <= column < self.columns
        return row * self.columns + column if inside else self.rows * self.columns

    def time(self, step: int) -> datetime:
        """The time of a step."""
        return self.start + step * self.step


def paths_of(motions: Iterable[Episode] | Tracks, places: Places) -> list[GroundTruthPath]:
    """The true path of each episode or recorded track, a state in the middle of its cell at each step.

    Where a target left the grid the path ends one step after its last cell; the last state says so in its metadata.
    """
    paths = []
    for number, (cells, exits) in enumerate(_cells_of(motions, places.rows * places.columns)):
        states = [
            GroundTruthState(places.centre(cell), timestamp=places.time(t), metadata={"cell": int(cell)})
            for t, cell in enumerate(cells)
        ]
        states[-1].metadata["exits"] = exits
        paths.append(GroundTruthPath(states, id=str(number)))
    return paths


def _cells_of(motions: Iterable[Episode] | Tracks, num_cells: int) -> Iterator[tuple[npt.NDArray[np.int64], bool]]:
    if isinstance(motions, Tracks):
        for number, (begin, end) in enumerate(zip(motions.first[:-1], motions.first[1:], strict=True)):
            yield motions.cells[begin:end], bool(motions.exits[number])
    else:
        for episode in motions:
            cells = np.concatenate([[episode.start], episode.target])
            # M, the exit, is no place.
            yield cells[cells < num_cells], episode.terminated


def tracks_of(paths: Sequence[GroundTruthPath], places: Places) -> Tracks:
    """The recorded tracks of some paths, one cell for each state.

    A path's part before it first leaves the grid is kept. It ended with an exit if it left, or if the last state's
    metadata says `exits`.

    Raises:
        UserError: a path begins outside the grid.
    """
    cells, exits = [], []
    for number, path in enumerate(paths):
        found = np.array([places.cell(state) for state in path])
        outside = np.flatnonzero(found == places.rows * places.columns)
        if not len(found) or found[0] == places.rows * places.columns:
            raise UserError(f"paths[{number}]: expected a path that begins in the grid")
        cells.append(found[: outside[0]] if len(outside) else found)
        exits.append(bool(len(outside)) or _exits(path))
    ends = ends_of(np.array([len(each) for each in cells]))
    return Tracks(np.concatenate(cells), ends, np.array(exits), np.arange(len(paths)))


class _Switch(Action):
    def act(self, current_time: datetime, timestamp: datetime, init_value: bool, **_: Any) -> bool:  # noqa: ARG002
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
        """Off: a sensor costs only where it is asked for."""
        return next(iter(self))


class CellSensor(Sensor):
    """The sensor of one cell: while it is on, it reports a target in its cell, always, at the cell's middle."""

    cell: int = Property(doc="Number of the cell.")
    places: Places = Property(doc="Where the cells lie.")
    on: bool = ActionableProperty(generator_cls=_Switches, default=False, doc="Whether it is on.")

    @classmethod
    def grid(cls, places: Places) -> list[FixedPlatform]:
        """A platform in the middle of every cell, with its sensor, all of them off."""
        platforms = []
        for cell in range(places.rows * places.columns):
            state = State(places.centre(cell), timestamp=places.start)
            sensor = cls(cell=cell, places=places)
            platforms.append(FixedPlatform(states=state, position_mapping=(0, 1), sensors=[sensor]))
        return platforms

    @property
    def measurement_model(self) -> LinearGaussian:
        """The middle of the cell; its variance is that of a place somewhere in it."""
        spread = np.eye(2) * self.places.side**2 / 12
        return LinearGaussian(ndim_state=max(self.places.mapping) + 1, mapping=self.places.mapping, noise_covar=spread)

    def measure(self, ground_truths: set[GroundTruthState], noise: Any = False, **_: Any) -> set[TrueDetection]:  # noqa: ARG002
        """The reports of those that are in its cell, none while it is off; there is no noise."""
        centre, model = self.places.centre(self.cell), self.measurement_model
        return {
            TrueDetection(centre, measurement_model=model, timestamp=truth.timestamp, groundtruth_path=truth)
            for truth in ground_truths
            if self.on and self.places.cell(truth) == self.cell
        }


class PolicySensorManager(SensorManager):
    """Switches on the sensors that a policy chooses for each track.

    A track has one state a step: an `Update` where its target was located, something else where it was missed. From
    them the last located cell and the misses since then are read; after t_max + 1 misses all sensors are on (the safe
    action). With several tracks a sensor is on that is chosen for one of them.
    """

    policy: Policy = Property(doc="A deterministic policy that remembers the last located cell alone.")
    places: Places = Property(doc="Where the cells lie.")

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        task = self.policy.task
        perfect = task.perfect and task.safe and task.coverage is None
        if not self.policy.deterministic or task.order or not perfect:
            expected = "a deterministic one of the last cell, and one sensor a cell without misses"
            raise UserError(f"policy: expected {expected}")

    def known(self, track: Track) -> tuple[int, int]:
        """The cell in which a track's target was last located, and the misses since then."""
        misses = next(n for n, state in enumerate(reversed(track.states)) if isinstance(state, Update))
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


@dataclass(frozen=True, eq=False)
class Followed:
    """One target, followed in Stone Soup.

    Attributes:
        track: what was known of it: its cell where it was located, else the cell of the last time.
        action: `[T, M]`, the sensors on in each step.
        located: `[T]`, whether it was located.
        reward: `[T]`, as in `TrackEnv`.
    """

    track: Track
    action: BoolArray
    located: BoolArray
    reward: npt.NDArray[np.float32]


def follow(manager: PolicySensorManager, path: GroundTruthPath) -> Followed:
    """Follow a path with the manager's sensors, from its first state on, where the target is known to be."""
    places, task, costs = manager.places, manager.policy.task, Costs(manager.policy.task)
    sensors = sorted(manager.sensors, key=lambda sensor: sensor.cell)
    for sensor in sensors:  # they may have followed another path before, to a later time
        sensor.timestamp, sensor.on = path[0].timestamp, False
    start = places.cell(path[0])
    sensors[start].on = True
    track, taken = Track([_update(*sensors[start].measure({path[0]}))]), []
    sensors[start].on = False
    # A path that ends with an exit has one more step, in which there is no target.
    for truth in [*path[1:], *([None] if _exits(path) else [])]:
        time = track[-1].timestamp + places.step if truth is None else truth.timestamp
        _, misses = manager.known(track)
        (switched,) = manager.choose_actions({track}, time)
        for sensor, actions in switched.items():
            sensor.add_actions(actions)
            sensor.act(time)
        found = [report for sensor in sensors if truth is not None for report in sensor.measure({truth})]
        action = np.array([sensor.on for sensor in sensors])
        became = (bool(found), misses > task.t_max, truth is not None)
        located, forced, in_grid = (torch.tensor([each]) for each in became)
        reward = costs.pseudo_reward(costs.price_of(torch.as_tensor(action)[None]), located, forced, in_grid)
        taken.append((action, bool(found), reward.item()))
        if truth is not None:
            track.append(_update(found[0]) if found else StatePrediction(track[-1].state_vector, timestamp=time))
    actions, seen, rewards = zip(*taken, strict=True)
    return Followed(track, np.stack(actions), np.array(seen), np.array(rewards, dtype=np.float32))


def _exits(path: GroundTruthPath) -> bool:
    return bool(getattr(path[-1], "metadata", {}).get("exits", False))


def _update(detection: TrueDetection) -> StateUpdate:
    # What was predicted does not matter: a report is certain.
    place, time = detection.state_vector, detection.timestamp
    hypothesis = SingleHypothesis(StatePrediction(place, timestamp=time), detection)
    return StateUpdate(place, hypothesis=hypothesis, timestamp=time)


def gospa(tracks: Sequence[Track], paths: Sequence[GroundTruthPath], *, c: float = 2.0, p: float = 2.0) -> Any:
    """Stone Soup's GOSPA (Rahmathullah, García-Fernández, Svensson, 2017) of tracks against true paths, step by step.

    Args:
        tracks: estimates.
        paths: truths.
        c: cutoff distance, in the unit of the coordinates.
        p: exponent.

    Returns:
        `{"distance", "localisation", "missed", "false"}`, means over the steps.
    """
    generator = GOSPAMetric(c=c, p=p, tracks_key="tracks", truths_key="truths")
    manager = MultiManager([generator])
    manager.add_data({"tracks": tracks, "truths": paths})
    (metric,) = manager.generate_metrics()[generator.generator_name].values()
    steps = metric.value if isinstance(metric.value, list) else [metric]
    names = ("distance", "localisation", "missed", "false")
    return {name: float(np.mean([step.value[name] for step in steps])) for name in names}
