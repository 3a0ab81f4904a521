"""Beliefs along episodes, computed after the simulation, for displays and logs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trackmdp.episodes.episode import Episode, Floats
from trackmdp.policies.belief import BeliefFilter, Reports
from trackmdp.world.model import World


def beliefs(world: World, episodes: Sequence[Episode]) -> list[Floats]:
    """For each episode `[T, M]`, the probability of each cell after a step's move, given the observations before it.

    A row sums to the probability of no exit. Each is the same to the bit for any other episodes. Targets with a mode
    are followed as (cell, mode), also through detections that do not reveal it.
    """
    exact, told, chance = BeliefFilter(world.kernel, world.modes), world.tells_all, Reports(world)
    lengths = np.array([len(episode) for episode in episodes])
    first = np.cumsum(lengths) - lengths
    action, misses, target, located = (
        np.concatenate([getattr(episode, name) for episode in episodes])
        for name in ("action", "misses", "target", "located")
    )
    # 0 where targets have none
    mode = np.concatenate(
        [0 * each.target if each.mode is None else each.mode for each in episodes]
    )
    found = np.zeros((len(target), world.num_cells), np.float32)
    start, start_mode = (
        np.array([getattr(each, name) for each in episodes]) for name in ("start", "start_mode")
    )
    belief, rows = exact.detect(start, start_mode if told else None), np.arange(len(episodes))
    for t in range(int(lengths.max())):
        # Episodes that have ended leave the batch, `rows` says which ones the rows of `belief` belong to.
        going_on = lengths[rows] > t
        rows, belief = rows[going_on], belief[going_on]
        step = first[rows] + t
        seen, predicted = located[step], exact.predict(belief)
        found[step] = exact.cells(predicted)
        # An exit ends the episode; its cell M has no belief, and cell 0 stands in, unused.
        at = exact.detect(target[step] * seen, mode[step] * seen if told else None, predicted)
        missed = exact.miss(predicted, chance(action[step], misses[step]))
        belief = np.where(seen[:, None], at, missed)
    return np.split(found, first[1:])
