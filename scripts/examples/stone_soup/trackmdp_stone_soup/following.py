"""Following a true path with the manager's sensors, and Stone Soup's GOSPA of the resulting track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from stonesoup.metricgenerator.manager import MultiManager
from stonesoup.metricgenerator.ospametric import GOSPAMetric
from stonesoup.types.detection import Detection, TrueDetection
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import StatePrediction
from stonesoup.types.track import Track
from stonesoup.types.update import StateUpdate

from trackmdp.arrays.types import BoolArray
from trackmdp.episodes.episode import Episode, last_cells
from trackmdp_stone_soup.places import Places, ends_with_exit
from trackmdp_stone_soup.sensors import PolicySensorManager


@dataclass(frozen=True, eq=False)
class Followed:
    """One target, followed in Stone Soup for T steps.

    Attributes:
        track: one state a step: an update where the target was located, else a prediction in its last known cell.
        action: `[T, M]`, the sensors on in each step.
        located: `[T]`, whether it was located.
        reward: `[T]`, as in `TrackEnv`: r for a detection less the prices, D after t_max + 1 misses; 0 on the exit.
    """

    track: Track
    action: BoolArray
    located: BoolArray
    reward: npt.NDArray[np.float64]


def follow(manager: PolicySensorManager, path: GroundTruthPath) -> Followed:
    """Follow a path with the manager's sensors, from its first state on, in which the target is located."""
    places, task = manager.places, manager.policy.task
    track = Track([_first(manager, path)])
    actions, located, rewards = [], [], []
    # A path that ends with an exit has one more step, in which there is no target.
    for truth in [*path[1:], *([None] if ends_with_exit(path) else [])]:
        time = track[-1].timestamp + places.step if truth is None else truth.timestamp
        _, misses = manager.known(track)
        action = _switch(manager, track, time)
        found = [] if truth is None else _reports(manager, truth)
        price = task.safe_cost if misses > task.t_max else task.cost[action].sum()
        actions.append(action)
        located.append(bool(found))
        rewards.append(0.0 if truth is None else task.reward * bool(found) - price)
        if found:
            track.append(_update(found[0]))
        elif truth is not None:
            track.append(StatePrediction(track[-1].state_vector, timestamp=time))
    return Followed(track, np.stack(actions), np.array(located), np.array(rewards))


def _first(manager: PolicySensorManager, path: GroundTruthPath) -> StateUpdate:
    """The report of the start; afterwards all sensors are off."""
    # They may have followed another path before, to a later time.
    for sensor in manager.sensors:
        sensor.timestamp = path[0].timestamp
        sensor.on = sensor.cell == manager.places.cell(path[0])
    (report,) = _reports(manager, path[0])
    for sensor in manager.sensors:
        sensor.on = False
    return _update(report)


def _switch(manager: PolicySensorManager, track: Track, time: object) -> BoolArray:
    """`[M]` the sensors that the manager switches on for the step that ends at `time`."""
    (switched,) = manager.choose_actions({track}, time)
    on = np.zeros(manager.places.num_cells, dtype=bool)
    for sensor, actions in switched.items():
        sensor.add_actions(actions)
        sensor.act(time)
        on[sensor.cell] = sensor.on
    return on


def _reports(manager: PolicySensorManager, truth: GroundTruthState) -> list[TrueDetection]:
    return [report for sensor in manager.sensors for report in sensor.measure({truth})]


def seen_of(episode: Episode, places: Places) -> list[Track]:
    """What was known of each target of an episode, as a track that ends when it leaves the grid.

    A track has one state a step: an update where its target was located, else its last known place.
    """
    tracks = []
    for each in episode.singles():
        inside = each.target < places.num_cells
        known = zip(
            last_cells(each.start, each.target, each.located)[1:], each.located, strict=True
        )
        states = [_report(places, each.start, 0)]
        for t, (cell, located) in enumerate(known, start=1):
            if inside[t - 1]:
                point = StatePrediction(places.centre(cell), timestamp=places.time(t))
                states.append(_report(places, cell, t) if located else point)
        tracks.append(Track(states))
    return tracks


def _report(places: Places, cell: int, step: int) -> StateUpdate:
    return _update(Detection(places.centre(cell), timestamp=places.time(step)))


def _update(detection: Detection) -> StateUpdate:
    # A report is certain: the prediction before it does not matter.
    place, time = detection.state_vector, detection.timestamp
    hypothesis = SingleHypothesis(StatePrediction(place, timestamp=time), detection)
    return StateUpdate(place, hypothesis=hypothesis, timestamp=time)


def gospa(
    tracks: Sequence[Track], paths: Sequence[GroundTruthPath], *, c: float = 2.0, p: float = 2.0
) -> dict[str, float]:
    """Stone Soup's GOSPA (Rahmathullah, García-Fernández, Svensson, 2017) of tracks against true paths, step by step.

    Args:
        tracks: estimates.
        paths: truths.
        c: cutoff distance, in the unit of the coordinates.
        p: exponent.

    Returns:
        Means over the steps of `distance`, `localisation`, `missed` and `false`.
    """
    generator = GOSPAMetric(c=c, p=p, tracks_key="tracks", truths_key="truths")
    manager = MultiManager([generator])
    manager.add_data({"tracks": tracks, "truths": paths})
    (metric,) = manager.generate_metrics()[generator.generator_name].values()
    steps = metric.value if isinstance(metric.value, list) else [metric]
    names = ("distance", "localisation", "missed", "false")
    return {name: float(np.mean([step.value[name] for step in steps])) for name in names}
