"""The belief along episodes, computed after the simulation, for displays and logs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy import sparse

from trackmdp.episodes.episode import Episode, Floats
from trackmdp.world.belief import BeliefFilter, summed
from trackmdp.world.model import Task
from trackmdp.world.modes import HiddenWorld, Modelled


def beliefs(world: Modelled, episodes: Sequence[Episode]) -> list[Floats]:
    """For each episode `[T, M]`, the probability of each cell after a step's move, given what was observed before it.

    A row sums to the probability of no exit. Each is the same to the bit whatever the other episodes are. Targets with
    a mode are followed as (cell, mode), through detections that do not tell it as well.
    """
    exact = BeliefFilter(world.kernel)
    modes = world.modes if isinstance(world, HiddenWorld) else 1
    cell = torch.arange(exact.num_cells) // modes  # of each hidden state
    cells = sparse.csr_array((np.ones(len(cell)), (cell.numpy(), np.arange(len(cell)))))
    told = modes == world.revealed  # with a single mode, too
    lengths = torch.tensor([len(episode) for episode in episodes])
    first = lengths.cumsum(0) - lengths
    action = torch.as_tensor(np.concatenate([_reported(world, episode) for episode in episodes]))
    target = torch.as_tensor(np.concatenate([episode.target for episode in episodes]))
    located = torch.as_tensor(np.concatenate([episode.located for episode in episodes]))
    # 0 where targets have none
    mode = torch.as_tensor(np.concatenate([0 * each.target if each.mode is None else each.mode for each in episodes]))
    found = torch.zeros(len(target), world.num_cells)
    start, first_mode = (torch.tensor([getattr(each, name) for each in episodes]) for name in ("start", "start_mode"))
    # Where the mode is not told, any of the cell's is as likely at the start.
    belief = exact.detect(start * modes + first_mode) if told else (cell == start[:, None]).double() / modes
    rows = torch.arange(len(episodes))
    for t in range(int(lengths.max())):
        # Episodes that have ended leave the batch, `rows` says which ones the rows of `belief` belong to.
        going_on = lengths[rows] > t
        rows, belief = rows[going_on], belief[going_on]
        step = first[rows] + t
        predicted = exact.predict(belief)
        found[step] = (predicted if modes == 1 else summed(cells, predicted)).float()
        # An exit ends the episode; its cell M has no belief, and cell 0 stands in, unused.
        at = target[step] * located[step]
        if told:
            seen = exact.detect(at * modes + mode[step] * located[step])
        else:  # what was predicted of the cell's modes
            seen = exact.miss(predicted, cell != at[:, None])
        belief = torch.where(
            located[step, None], seen, exact.miss(predicted, action[step].repeat_interleave(modes, -1))
        )
    return [part.numpy() for part in found.split(lengths.tolist())]


def _reported(world: Task, episode: Episode) -> npt.NDArray[Any]:
    """`[T, M]` probability that a step reports a target in each cell; the action itself where reports are certain."""
    if world.perfect and world.safe:
        return world.covered(episode.action)
    forced = episode.misses > world.t_max
    return np.where(forced[:, None], world.safe_detection, episode.action * world.detection)
